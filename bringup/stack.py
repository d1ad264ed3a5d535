"""Play episodes through the graph and gather what comes of them."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rclpy.executors import Executor
from rclpy.parameter import Parameter

from bringup.command import Player, Solo
from bringup.domain import claim_domain
from bringup.graph import RESPAWN_PERIOD, GraphError, InProcess, Processes
from bringup.graph_recorder import RecorderNode
from bringup.monitor import MonitorNode
from bringup.parameters import graph_parameters
from bringup.results import EpisodeResult, told_roles
from bringup.video import EDGE, VideoNode
from mujoban_core import children
from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.plugins import privileged_roles
from mujoban_core.signals import StopSignal
from mujoban_core.threads import set_threads
from mujoban_msgs_py.run_identifier import ANY, draw_run
from mujoban_msgs_py.runtime.discovery import reaches_further
from mujoban_msgs_py.runtime.shared_memory import clear_shared_memory
from mujoban_msgs_py.runtime.tick_node import ros_context, spin
from mujoban_sim.node import SimulatorNode
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.episodes import Episodes

DRAIN_TIMEOUT = 5.0
"""Seconds that recorder and video have for the last tick."""


def _run() -> int:
    """Return the identifier of a run: drawn where it may meet others; on this host it has a domain of its own."""
    return draw_run() if reaches_further() else 0


@dataclass(frozen=True)
class PlayOptions:
    """How the graph is run."""

    world: str = DEFAULT_WORLD
    """The physical world, see `mujoban_sim.presets`."""
    realtime: float = 0.0
    """Simulated seconds per second; 0 is lockstep."""
    time_limit: int | None = None
    """Steps of an episode; None means that of the body."""
    processes: bool = False
    """One process for each node."""
    intra_process: bool = True
    """Messages of which nobody outside this process hears are handed over, not sent."""
    record: Path | None = None
    """Folder of the bag to write."""
    episodes_per_file: int = 32
    """Episodes in one file of the bag."""
    video: Path | None = None
    """Video file to write."""
    view: str | None = None
    """IP address on which a live view is served to the browser, from a process of its own."""
    run: int = field(default_factory=_run)
    """Its identifier, which keeps it apart from other runs, see `mujoban_msgs_py.run_identifier`."""


@dataclass(frozen=True)
class Outcome:
    """What came of a run of the graph."""

    results: list[EpisodeResult]
    ticks: int
    ticks_per_second: float
    counts: Counter[str]
    """Events that a user should know of: of the nodes in this process, and how often others were started again."""
    answer_ms: dict[str, float] = field(default_factory=dict[str, float])
    """Milliseconds from the offer of a tick to its torque, percentiles of the latest ticks: p50, p99; none where the
    simulator has a process of its own, whose /diagnostics tell."""

    def figures(self) -> dict[str, Any]:
        """Return the entries of a report that tell how the graph ran."""
        told: dict[str, Any] = {"ticks_per_second": self.ticks_per_second, "counts": dict(self.counts)}
        return told | ({"answer_ms": self.answer_ms} if self.answer_ms else {})


def play(
    stack: Player,
    episodes: Episodes,
    options: PlayOptions | None = None,
    *,
    on_refresh: Callable[[MonitorNode, Sequence[EpisodeResult]], None] | None = None,
    refresh_period: float = 0.1,
    on_break: Callable[[Outcome], None] | None = None,
) -> Outcome:
    """Play episodes through the graph.

    Args:
        stack: The modules, or an agent.
        episodes: The episodes.
        options: How the graph is run; in lockstep and in this process by default.
        on_refresh: Called every `refresh_period` seconds with what the graph is doing.
        refresh_period: Seconds.
        on_break: Called with what came of it so far when an interruption or an error ends the run.

    Raises:
        ValueError: If a module cannot be loaded.
        GraphError: If a node's process could not start.
        Interrupted: If the process was asked to end; bag and video are whole then.
    """
    options = options or PlayOptions()
    parameters = graph_parameters(
        stack,
        episodes,
        run=options.run,
        world=options.world,
        realtime=options.realtime,
        time_limit=options.time_limit or 0,
        await_recorder=options.record is not None,
        top_camera_size=top_camera_size(stack, options.video is not None),
    )
    with ExitStack() as exits:
        stop = exits.enter_context(StopSignal(deferred=False))
        set_threads(stack.threads)
        clear_shared_memory()
        exits.enter_context(claim_domain())
        exits.enter_context(ros_context())
        graph = exits.enter_context(
            InProcess(parameters, () if options.processes else parameters, intra_process=options.intra_process)
        )
        alone = isinstance(stack, Solo)
        monitor = graph.add(MonitorNode(episodes, alone=alone, run=options.run, intra_process=graph.intra_process))
        stop.deferred = True  # from here on there are files to finish
        listeners: list[RecorderNode | VideoNode] = []
        if options.record is not None:
            listeners.append(graph.add(_recorder(options.record, options, stack, episodes.max_boxes)))
        if options.video is not None:
            video = VideoNode(
                options.video,
                alone=alone,
                told=privileged_roles(stack.identities()),
                run=options.run,
                intra_process=graph.intra_process,
            )
            listeners.append(graph.add(video))
        if options.view is not None:
            exits.enter_context(viewer(options.view, options.run))
        processes = exits.enter_context(Processes(parameters)) if options.processes else None
        if processes is not None:
            monitor.watch.ghosts = processes.ghosts
            monitor.create_timer(RESPAWN_PERIOD, lambda: _supervise(processes, monitor))
        if on_refresh is not None:
            monitor.create_timer(refresh_period, lambda: on_refresh(monitor, monitor.results))
        try:
            spin(graph.executor, monitor.finished, stop)
            monitor.finished.result()
        except BaseException:
            if on_break is not None:
                on_break(_outcome(graph, monitor, processes))
            raise
        if on_refresh is not None:  # a short run may have ended before the first refresh
            on_refresh(monitor, monitor.results)
        _drain(graph.executor, listeners, monitor.stamp)
        return _outcome(graph, monitor, processes)


def _outcome(graph: InProcess, monitor: MonitorNode, processes: Processes | None) -> Outcome:
    counts = graph.counts() + (Counter() if processes is None else processes.counts())
    return Outcome(monitor.results, monitor.ticks, monitor.ticks_per_second, counts, _answer_ms(graph))


def _answer_ms(graph: InProcess) -> dict[str, float]:
    simulator = graph.nodes.get("simulator")
    if not isinstance(simulator, SimulatorNode):
        return {}
    return {f"p{percentile}": simulator.pace.answer_ms(percentile) for percentile in (50, 99)}


def top_camera_size(player: Player, filmed: bool) -> int:
    """Return the pixels along the edge of the view from above.

    An agent may look at it, at the size that it was trained with. For people it has as many to a metre with every body:
    64 pixels of the ant's world, which is three times as large, show a dot.
    """
    if isinstance(player, Solo):
        return FRAME_SIZE
    return EDGE if filmed else round(FRAME_SIZE * get_body(player.body).cell_size)


def _supervise(processes: Processes, monitor: MonitorNode) -> None:
    """Start again what has ended; a graph that cannot go on ends the run, and `spin` with it."""
    try:
        processes.supervise(begun=monitor.ticks > 0)
    except GraphError as error:
        monitor.finished.set_exception(error)


def _drain(executor: Executor, listeners: Sequence[RecorderNode | VideoNode], stamp: int) -> None:
    """Let those who write files receive what was published last."""
    deadline = time.monotonic() + DRAIN_TIMEOUT
    while any(listener.written < stamp for listener in listeners) and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.05)


@contextmanager
def viewer(address: str, run: int = ANY) -> Iterator[None]:
    """Run `bringup.live` in a process of its own: drawing must not hold up the graph.

    Args:
        address: IP address on which it is served.
        run: Identifier of the run that it shows.

    Raises:
        ValueError: If Rerun is not installed.
    """
    if find_spec("rerun") is None:
        raise ValueError("the live view needs rerun-sdk: pip install 'mujoban[view]'")
    settings = ("-p", f"address:='{address}'", "-p", f"run:={run}")
    process = children.start([sys.executable, "-m", "bringup.live", "--ros-args", *settings])
    try:
        yield
    finally:
        children.stop([process])


def _recorder(path: Path, options: PlayOptions, stack: Player, max_boxes: int) -> RecorderNode:
    values = {
        "path": str(path), "episodes_per_file": options.episodes_per_file, "body": stack.body, "world": options.world,
        "privileged": told_roles(stack.identities()), "max_boxes": max_boxes, "instructed": not isinstance(stack, Solo),
        "run": options.run,
    }  # fmt: skip
    return RecorderNode(parameter_overrides=[Parameter(name, value=value) for name, value in values.items()])
