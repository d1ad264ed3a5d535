"""Four oracles on generated levels: shows that the world is sound, and what perfect modules would reach.

A body that no script drives has its privileged teacher among them. ``python -m benchmarks.oracles --levels 512`` prints
JSON: solved levels with a 95 % Wilson interval, return, steps and instructions per episode, instructions that ran into
their limit, the steps that an instruction takes, by kind, what plays and is told the ground truth, and, of levels kept
for tests, that they were used.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from benchmarks.command import run_benchmark
from bringup.command import Stack, oracle
from bringup.options import WorldOptions
from bringup.progress import EpisodesBar
from bringup.rollout import ticks
from mujoban_core.plugins import ROLES, privileged_roles
from mujoban_core.ranges import check_counts
from mujoban_core.stats import wilson_interval
from mujoban_rl.sealed_levels import noted_use
from mujoban_sim.goals import GoalKind
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

PROG = "benchmarks.oracles"


@dataclass(frozen=True)
class Options:
    """Which levels to play."""

    levels: int = 512
    difficulty: int = 5
    seed: int = VALIDATION_SEEDS.start
    batch: int = 64
    threads: int = 2
    physics: Annotated[WorldOptions, arg(name="")] = field(default_factory=WorldOptions)

    def __post_init__(self) -> None:
        """Reject fewer levels, games at once or threads than one."""
        check_counts(self, "levels", "batch", "threads")


def run(options: Options | None = None) -> dict[str, Any]:
    """Play every level once; see the module for what is returned.

    Raises:
        ValueError: If the seeds do not all lie in one range.
    """
    options = options or Options()
    body = options.physics.body
    stack = Stack({role: oracle(role, body) for role in ROLES}, body=body)
    seeds = range(options.seed, options.seed + options.levels)
    weights = stack.identities()
    noted = noted_use(seeds, weights, {"program": PROG, **asdict(options)})
    episodes = list(Episodes(options.levels, options.seed, difficulty=options.difficulty))
    batch = min(options.batch, len(episodes))
    world = World(batch, body=body, world=options.physics.world, threads=options.threads)
    policy = stack.policy()
    issued, timed_out, solved = 0, 0, []
    returns, lengths, unsolved = [], [], []
    durations: dict[GoalKind, list[int]] = {kind: [] for kind in GoalKind}
    begun, kind = np.zeros((2, batch), np.int64)
    start = time.perf_counter()
    with EpisodesBar(len(episodes)) as bar:
        for tick in ticks(policy, world, episodes):
            rows, termination = tick.rows, tick.decision.termination
            issued += int(tick.decision.issued.sum())
            timed_out += int(termination.timed_out.sum())
            for m in np.flatnonzero(termination.terminated & ~termination.timed_out):
                durations[GoalKind(kind[rows[m]])].append(int(tick.step[m] - begun[rows[m]]))
            new = tick.decision.issued
            begun[rows[new]], kind[rows[new]] = tick.step[new], world.goals.kind[rows[new]]
            for m in np.flatnonzero(tick.solved | tick.truncated):
                solved.append(bool(tick.solved[m]))
                returns.append(float(tick.episode_return[m]))
                lengths.append(int(tick.step[m]) + 1)
                if not tick.solved[m]:
                    unsolved.append(episodes[tick.episode[m]].seed)
                bar.reach(len(solved), "ended")
    return {
        "n": len(solved),
        "success_rate": float(np.mean(solved)),
        "success_interval": wilson_interval(sum(solved), len(solved)),
        "mean_return": float(np.mean(returns)),
        "median_steps": float(np.median(lengths)),
        "instructions": issued,
        "timed_out": timed_out,
        "steps_per_instruction": {
            kind.name.lower(): {"median": float(np.median(steps)), "p95": float(np.percentile(steps, 95))}
            for kind, steps in durations.items()
            if steps
        },
        "unsolved_seeds": unsolved,
        "seconds": time.perf_counter() - start,
        "weights": weights,
        "privileged": privileged_roles(weights),
        **noted,
    }


if __name__ == "__main__":
    run_benchmark(PROG, Options, run, __doc__)
