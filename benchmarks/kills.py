"""Kill the graph's nodes over and over, and see what a run loses: `python -m benchmarks.kills`.

Each node runs in a process of its own, which is killed (SIGKILL) at moments drawn anew and started again by the graph.
Printed are, for each mode and node, how long the graph stood still, and for each mode the episodes that were lost, came
twice or ended otherwise than in a run that nobody disturbed. In real time some time passes until the clock waits for a
module that is dead; so episodes have twice the ball's own here, lest it be the clock that loses them.
"""

from __future__ import annotations

import signal
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np

from benchmarks.command import run_benchmark
from bringup.command import Choice, Stack
from bringup.domain import claim_domain
from bringup.graph import NODES, RESPAWN_PERIOD, InProcess, Processes
from bringup.monitor import MonitorNode
from bringup.parameters import graph_parameters
from bringup.results import EpisodeResult
from bringup.stack import PlayOptions, play
from mujoban_core.plugins import ROLES
from mujoban_core.signals import StopSignal
from mujoban_msgs_py import topics
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.runtime.tick_node import ros_context, spin
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

Mode = Literal["lockstep", "real time"]
_PERIOD: Final = 0.02
"""Seconds between two looks at the graph."""
_BETWEEN: Final = (5, 40)
"""Ticks from when the graph goes on to the next kill."""


@dataclass(frozen=True)
class Options:
    """What is killed."""

    kills: int = 100
    """Of each node in each mode, if the episodes last."""
    episodes: int = 128
    difficulty: int = 3
    seed: int = VALIDATION_SEEDS.start
    nodes: tuple[str, ...] = tuple(NODES)
    modes: tuple[Mode, ...] = ("lockstep", "real time")
    speed: float = 2.0
    """Of real time."""
    time_limit: int = 9_600
    """Steps of an episode."""
    oracle: tuple[str, ...] = ()
    """Roles that oracles play; none by default."""
    json: bool = False
    """Print a JSON object in place of the table."""

    def stack(self) -> Stack:
        """Return the stack that plays."""
        return Stack({role: Choice(role, "oracle" if role in self.oracle else "learned") for role in ROLES})


class Killer:
    """Kills nodes in turns, each once the graph has gone on for some ticks since the one before.

    Attributes:
        still: Node -> seconds from each kill until all modules had answered a tick again.
    """

    def __init__(self, options: Options, processes: Processes, monitor: MonitorNode) -> None:
        """Plan the kills."""
        self._processes, self._monitor = processes, monitor
        self._rng = np.random.default_rng(options.seed)
        self._waiting = [node for _ in range(options.kills) for node in options.nodes]
        self.still: dict[str, list[float]] = {node: [] for node in options.nodes}
        self._due = _BETWEEN[1]
        self._torques, self._torque = 0, -1
        self._killed: tuple[str, float, int, int, int] | None = None
        listen(monitor, topics.TORQUE, self._on_torque)

    def _on_torque(self, message: Received) -> None:
        """Count what the controller says, which the monitor does not wait for."""
        if message.stamp > self._torque:
            self._torques, self._torque = self._torques + 1, message.stamp

    def look(self) -> None:
        """Kill the next node, or see whether the graph has recovered from the last kill."""
        ticks, now = self._monitor.ticks, time.monotonic()
        if self._killed is None:
            if self._waiting and ticks >= self._due:
                node = self._waiting.pop(0)
                self._processes.kill(node, signal.SIGKILL)
                self._killed = node, now, ticks, self._torques, self._processes.restarts[node]
            return
        node, since, before, torques, restarts = self._killed
        # One tick may have been on its way; the second is answered by the graph with the new process in it.
        if self._processes.restarts[node] > restarts and ticks > before + 1 and self._torques > torques + 1:
            self.still[node].append(now - since)
            self._killed = None
            self._due = ticks + int(self._rng.integers(*_BETWEEN))


def disturbed(options: Options, mode: Mode) -> tuple[list[EpisodeResult], dict[str, list[float]]]:
    """Play while nodes are killed; return the outcomes, and for each node how long the graph stood still [s]."""
    episodes = Episodes(options.episodes, options.seed, difficulty=options.difficulty)
    speed = options.speed if mode == "real time" else 0.0
    parameters = graph_parameters(options.stack(), episodes, realtime=speed, time_limit=options.time_limit)
    with ExitStack() as exits:
        stop = exits.enter_context(StopSignal())
        exits.enter_context(claim_domain())
        exits.enter_context(ros_context())
        graph = exits.enter_context(InProcess(parameters, ()))
        monitor = graph.add(MonitorNode(episodes))
        kills = options.kills * len(options.nodes)
        processes = exits.enter_context(Processes(parameters, restart_limit=kills))
        monitor.watch.ghosts = processes.ghosts
        killer = Killer(options, processes, monitor)
        monitor.create_timer(RESPAWN_PERIOD, processes.supervise)
        monitor.create_timer(_PERIOD, killer.look)
        spin(graph.executor, monitor.finished, stop)
        return list(monitor.results), killer.still


def compare(results: list[EpisodeResult], expected: list[EpisodeResult]) -> dict[str, Any]:
    """Return how the episodes of a disturbed run differ from those of one that nobody disturbed."""
    seeds, by_seed = [r.seed for r in results], {r.seed: r for r in results}
    lost = {e.seed: by_seed[e.seed].failure for e in expected if e.solved and e.seed in by_seed}
    return {
        "episodes": len(expected),
        "missing": sum(e.seed not in by_seed for e in expected),
        "twice": len(seeds) - len(set(seeds)),
        "solved": sum(r.solved for r in results),
        "solved_undisturbed": sum(e.solved for e in expected),
        "lost_by_kills": {seed: str(failure) for seed, failure in lost.items() if failure is not None},
        "equal": sum(by_seed.get(e.seed) == e for e in expected),
        "different": {e.seed: _differences(by_seed[e.seed], e) for e in expected if by_seed.get(e.seed, e) != e},
    }


def _differences(result: EpisodeResult, expected: EpisodeResult) -> str:
    one, other = result.to_json(), expected.to_json()
    return ", ".join(f"{name} {one[name]}, not {other[name]}" for name in one if one[name] != other[name])


def run(options: Options | None = None) -> dict[str, Any]:
    """Return, for each mode, what the kills did to the outcomes and how long the graph stood still."""
    chosen = options or Options()
    episodes = Episodes(chosen.episodes, chosen.seed, difficulty=chosen.difficulty)
    expected = play(chosen.stack(), episodes, PlayOptions(time_limit=chosen.time_limit)).results
    report: dict[str, Any] = {}
    for mode in chosen.modes:
        results, still = disturbed(chosen, mode)
        nodes = {
            node: {"kills": len(s), "median": float(np.median(s)), "longest": max(s)} for node, s in still.items() if s
        }
        report[mode] = {**compare(results, expected), "still_seconds": nodes}
        print(f"{mode}: {report[mode]}", file=sys.stderr)
    return report


def table(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    lines = ["| mode | node | kills | still, median s | longest s |", "|---|---|---|---|---|"]
    for mode, content in report.items():
        for node, still in content["still_seconds"].items():
            lines.append(f"| {mode} | {node} | {still['kills']} | {still['median']:.1f} | {still['longest']:.1f} |")
    lines += ["", "| mode | episodes | missing | twice | solved (undisturbed) | lost by kills | equal |"]
    lines.append("|---|---|---|---|---|---|---|")
    for mode, c in report.items():
        lines.append(
            f"| {mode} | {c['episodes']} | {c['missing']} | {c['twice']} | {c['solved']} ({c['solved_undisturbed']}) | "
            f"{', '.join(f'{seed}: {cause}' for seed, cause in c['lost_by_kills'].items()) or 0} | {c['equal']} |"
        )
    return "\n".join(lines)


def measure(options: Options) -> dict[str, Any] | str:
    """Return the outcome, as a table unless JSON is asked for."""
    outcome = run(options)
    return {"options": asdict(options), **outcome} if options.json else table(outcome)


if __name__ == "__main__":
    run_benchmark("benchmarks.kills", Options, measure)
