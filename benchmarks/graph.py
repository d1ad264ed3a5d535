"""Ticks per second of the learned stack: through the ROS graph in lockstep, and in one process without ROS.

``run`` measures both in turns, several times, so that what else the machine does hits them alike; the ratio is the
median over the rounds. ``python -m benchmarks.graph`` prints it as JSON.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict, dataclass

import torch

from benchmarks.command import run_benchmark
from bringup.command import Choice, Stack
from bringup.rollout import rollout
from bringup.stack import PlayOptions, play
from mujoban_core.plugins import ROLES
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


@dataclass
class Options:
    """What is measured."""

    ticks: int = 75
    """Of each contestant in a round."""
    rounds: int = 32
    difficulty: int = 5
    seed: int = 0
    oracle: tuple[str, ...] = ()
    """Roles that oracles play; none by default."""

    def stack(self) -> Stack:
        """Return the stack to measure."""
        return Stack({role: Choice(role, "oracle" if role in self.oracle else "learned") for role in ROLES})


def _in_process(policy: SensePlanAct, episodes: Episodes, ticks: int) -> float:
    world = World(1, max_boxes=episodes.max_boxes, time_limit=ticks)
    start = time.perf_counter()
    steps = sum(result.steps for result in rollout(policy, world, episodes))
    seconds = time.perf_counter() - start
    world.close()
    return steps / seconds


def run(options: Options | None = None) -> dict[str, float]:
    """Return ticks per second of graph and rollout with batch 1, and their ratio."""
    chosen = options or Options()
    torch.set_num_threads(1)
    stack = chosen.stack()
    policy = stack.policy()
    episodes = Episodes(1, chosen.seed, difficulty=chosen.difficulty)
    _in_process(policy, episodes, 20)
    rates: list[tuple[float, float]] = []
    for _ in range(chosen.rounds):
        graph = play(stack, episodes, PlayOptions(time_limit=chosen.ticks)).ticks_per_second
        rates.append((graph, _in_process(policy, episodes, chosen.ticks)))
    return {
        "graph_ticks_per_second": statistics.median(graph for graph, _ in rates),
        "rollout_ticks_per_second": statistics.median(plain for _, plain in rates),
        "graph_of_rollout": statistics.median(graph / plain for graph, plain in rates),
    }


if __name__ == "__main__":
    run_benchmark("benchmarks.graph", Options, lambda chosen: {"options": asdict(chosen), **run(chosen)})
