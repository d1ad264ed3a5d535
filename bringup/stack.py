"""Play episodes through the graph and gather what comes of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import rclpy

from bringup.command import Stack
from bringup.domain import claim_domain
from bringup.graph import NODES, RESPAWN_PERIOD, InProcess, Processes
from bringup.monitor import MonitorNode
from bringup.parameters import graph_parameters
from bringup.results import EpisodeResult
from mujoban_msgs_py.tick_node import confine_discovery, spin
from mujoban_sim.episodes import Episodes


@dataclass(frozen=True)
class PlayOptions:
    """How the graph is run."""

    realtime: float = 0.0
    """Simulated seconds per second; 0 is lockstep."""
    processes: bool = False
    """One process for each node."""
    record: Path | None = None
    """Directory of the bag to write."""
    video: Path | None = None
    """Video file to write."""


@dataclass(frozen=True)
class Outcome:
    """What came of a run of the graph."""

    results: list[EpisodeResult]
    ticks: int
    ticks_per_second: float
    counts: Counter[str]
    """Events of the nodes that a user should know of."""


def play(
    stack: Stack,
    episodes: Episodes,
    options: PlayOptions | None = None,
    *,
    on_refresh: Callable[[MonitorNode, Sequence[EpisodeResult]], None] | None = None,
    refresh_period: float = 0.1,
) -> Outcome:
    """Play episodes through the graph.

    Args:
        stack: The modules.
        episodes: The episodes.
        options: How the graph is run; in lockstep and in this process by default.
        on_refresh: Called every `refresh_period` seconds with what the graph is doing.
        refresh_period: Seconds.

    Raises:
        ValueError: If a module cannot be loaded.
        GraphError: If a node's process could not start.
    """
    options = options or PlayOptions()
    parameters = graph_parameters(
        stack, episodes, realtime=options.realtime, await_recorder=options.record is not None and not options.realtime
    )
    confine_discovery()
    with ExitStack() as exits:
        exits.enter_context(claim_domain())
        rclpy.init()
        exits.callback(rclpy.try_shutdown)
        graph = exits.enter_context(InProcess(parameters, () if options.processes else NODES))
        monitor = graph.add(MonitorNode(len(episodes)))
        if options.processes:
            processes = exits.enter_context(Processes(parameters))
            monitor.create_timer(RESPAWN_PERIOD, processes.supervise)
        if on_refresh is not None:
            monitor.create_timer(refresh_period, lambda: on_refresh(monitor, monitor.results))
        spin(graph.executor, monitor.finished)
        counts = processes.restarts if options.processes else graph.counts()
        return Outcome(monitor.results, monitor.ticks, monitor.ticks_per_second, counts)
