"""Whether the agents of Table 1 are sound: each learns a small task on pixels from nothing, by the code that trains it.

    python -m benchmarks.golden                      # all of them: JSON, status 1 if one has not solved it
    python -m benchmarks.golden --agents mpo-symmetric --cpu-minutes 5

The task is `mujoban_baselines.squares`: walk to the red square and not to the blue one, in frames of 64x64. By chance
half of the squares that are reached are red.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import torch

from mujoban_baselines.agents import StructuredAgent, TopDownAgent
from mujoban_baselines.impala import VTraceTrainingConfig
from mujoban_baselines.mpo import MPOTrainingConfig
from mujoban_baselines.squares import SquaresTask
from mujoban_baselines.task import TaskConfig
from mujoban_baselines.train import MPORunConfig, Parts, VTraceRunConfig, mpo_parts, vtrace_parts
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_positive
from mujoban_rl.actors import ActorOptions
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo_continuous import MPOConfig

PROG: Final = "benchmarks.golden"

SOLVED: Final = 0.9
"""Share of episodes that must end at the red square."""
_BETWEEN: Final = 20
"""Updates between two looks at how far it is."""
QUICK: Final = MPOTrainingConfig(
    window=12,
    warm_up=2,
    windows=16,
    replay=12_000,
    first=1_000,
    exploration="white",  # a walker without a mass goes where the noise pushes it
    n_step=3,
    reuse=2.0,
    rate=1e-3,
    gamma=0.9,
    target_period=10,
    loss=MPOConfig(epsilon_mean=0.03, epsilon_scale=1e-3, initial_temperature=0.3),
)


_ROBOTS: Final = 16
_UNROLL: Final = VTraceTrainingConfig(unroll=10, rate=5e-4, gamma=0.9)


def _mpo(critic: Any, seed: int) -> Parts:
    config = MPORunConfig(seed=seed, critic=critic, mpo=QUICK)
    return mpo_parts(config, ActorOptions(), partial(SquaresTask, batch=_ROBOTS))


def _vtrace(kind: type[TopDownAgent], seed: int) -> Parts:
    config = VTraceRunConfig(seed=seed, task=TaskConfig(robots=_ROBOTS), vtrace=_UNROLL)
    return vtrace_parts(config, kind, ActorOptions(), partial(SquaresTask, batch=_ROBOTS))


AGENTS: Final[dict[str, Callable[[int], Parts]]] = {
    "mpo-asymmetric": partial(_mpo, "asymmetric"),
    "mpo-symmetric": partial(_mpo, "symmetric"),
    "vtrace-monolithic": partial(_vtrace, TopDownAgent),
    "vtrace-structured": partial(_vtrace, StructuredAgent),
}


@dataclass(frozen=True)
class Options:
    """Train agents on a small task until they have solved it."""

    agents: tuple[str, ...] = tuple(AGENTS)
    cpu_minutes: float = 20.0
    """Of one core, for each agent."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Reject nobody, whom nobody knows, and a time that never comes."""
        unknown = set(self.agents) - AGENTS.keys()
        if unknown or not self.agents:
            raise ValueError(f"--agents {min(unknown, default='is empty')}: expected some of {', '.join(AGENTS)}")
        check_positive(self, "cpu_minutes")
        check_counts(self, "seed", least=0)


def learn(name: str, cpu_seconds: float, seed: int) -> dict[str, Any]:
    """Train an agent until it has solved the task or has spent its time; return what it took."""
    (learner, source), guard = AGENTS[name](seed), NaNGuard()
    source.publish(learner.weights(), 0)
    start, curve = time.process_time(), [(0, 0.0)]
    while time.process_time() - start < cpu_seconds:
        for update in range(_BETWEEN):
            batch = source.next_batch()
            learner.update(batch, (time.process_time() - start) / cpu_seconds, guard)
            if update % 2:
                source.publish(learner.weights(), update)
        seen = source.statistics()
        if "solved" in seen:
            curve.append((source.samples, round(seen["solved"], 3)))
            print(f"{name}: {source.samples} steps, solved {curve[-1][1]:.0%}", file=sys.stderr, flush=True)
        if _passes(curve):
            break
    source.close()
    spent = time.process_time() - start
    report = {"passes": _passes(curve), "solved": curve[-1][1], "steps": source.samples}
    return {**report, "cpu_seconds": round(spent, 1), "curve": curve}


def _passes(curve: Sequence[tuple[int, float]]) -> bool:
    """Return whether the task was solved in two looks in succession."""
    return min(value for _, value in curve[-2:]) >= SOLVED


def main(command_line: Sequence[str] | None = None) -> int:
    """Train the agents that are named; return 1 if one has not solved the task."""
    options = read_options(Options, command_line, PROG, __doc__)
    torch.set_num_threads(1)
    report = {name: learn(name, 60.0 * options.cpu_minutes, options.seed) for name in options.agents}
    print(json.dumps(report, indent=2))
    return int(not all(outcome["passes"] for outcome in report.values()))


if __name__ == "__main__":
    run_command(PROG, main)
