"""Ticks per second of the learned stack: through the ROS graph in lockstep, and in one process without ROS.

``run`` measures both in turns, several times, so that what else the machine does hits them alike; the ratio is the
median over the rounds. ``python -m benchmarks.graph`` prints it as JSON. With ``--realtime`` it is how long the graph
takes to answer a tick of real time, without a search ahead and with one, in turns too.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import torch
from tyro.conf import arg

from benchmarks.command import run_benchmark
from bringup.command import Choice, Stack
from bringup.options import WorldOptions
from bringup.rollout import ticks
from bringup.stack import PlayOptions, play
from mujoban_core.plugins import ROLES
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_planner.deliberation import LOOK_AHEAD, Deliberation
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS


@dataclass
class Options:
    """What is measured."""

    ticks: int = 300
    """Of each contestant in a round."""
    rounds: int = 16
    difficulty: int = 5
    seed: int = VALIDATION_SEEDS.start
    oracle: tuple[str, ...] = ()
    """Roles that oracles play; none by default."""
    realtime: float = 0.0
    """Measure answers in real time at this speed, without and with a search ahead; 0: throughput in lockstep."""
    look_ahead: int = LOOK_AHEAD
    """Evaluations of that search."""
    intra_process: bool = True
    """Whether nodes hand over messages that nobody else reads, as `run_stack.py` does; else the middleware has all."""
    physics: Annotated[WorldOptions, arg(name="")] = field(default_factory=WorldOptions)

    def stack(self, look_ahead: int | None = None) -> Stack:
        """Return the stack to measure."""
        choices = {role: Choice(role, "oracle" if role in self.oracle else "learned") for role in ROLES}
        return Stack(choices, deliberation=Deliberation(look_ahead=look_ahead), body=self.physics.body)

    def play_options(self) -> PlayOptions:
        """Return how the graph is run."""
        return PlayOptions(
            world=self.physics.world,
            realtime=self.realtime,
            time_limit=self.ticks,
            intra_process=self.intra_process,
        )


def _in_process(policy: SensePlanAct, episodes: Episodes, options: Options) -> float:
    """Return ticks per second from the first tick on, without ROS."""
    physics = options.physics
    world = World(
        1, body=physics.body, world=physics.world, max_boxes=episodes.max_boxes, time_limit=options.ticks
    )
    # As the monitor of a graph counts: compiling the level is no tick.
    ends = [time.perf_counter() for _ in ticks(policy, world, episodes)]
    world.close()
    return (len(ends) - 1) / (ends[-1] - ends[0])


def run(options: Options | None = None) -> dict[str, float]:
    """Return ticks per second of graph and rollout with batch 1, and their ratio."""
    chosen = options or Options()
    torch.set_num_threads(1)
    stack = chosen.stack()
    policy = stack.policy()
    episodes = Episodes(1, chosen.seed, difficulty=chosen.difficulty)
    _in_process(policy, episodes, replace(chosen, ticks=20))
    rates: list[tuple[float, float]] = []
    for _ in range(chosen.rounds):
        graph = play(stack, episodes, chosen.play_options()).ticks_per_second
        rates.append((graph, _in_process(policy, episodes, chosen)))
    return {
        "graph_ticks_per_second": statistics.median(graph for graph, _ in rates),
        "rollout_ticks_per_second": statistics.median(plain for _, plain in rates),
        "graph_of_rollout": statistics.median(graph / plain for graph, plain in rates),
    }


def answers(options: Options) -> dict[str, dict[str, float]]:
    """Return how long answers take in real time, without a search ahead and with one.

    Each: percentiles in milliseconds, medians over the rounds, and the share of ticks without a torque of their own.
    """
    torch.set_num_threads(1)
    episodes = Episodes(1, options.seed, difficulty=options.difficulty)
    rounds: dict[str, list[dict[str, float]]] = {"alone": [], "looking_ahead": []}
    for _ in range(options.rounds):
        for name, evaluations in (("alone", 0), ("looking_ahead", options.look_ahead)):
            outcome = play(options.stack(evaluations), episodes, options.play_options())
            late = outcome.counts["simulator: late answers"] / outcome.results[0].steps
            rounds[name].append({**outcome.answer_ms, "late": late})
    return {
        name: {key: statistics.median(one[key] for one in each) for key in each[0]} for name, each in rounds.items()
    }


def report(options: Options) -> dict[str, Any]:
    """Return what was measured, and how."""
    return {"options": asdict(options), **(answers(options) if options.realtime else run(options))}


if __name__ == "__main__":
    run_benchmark("benchmarks.graph", Options, report)
