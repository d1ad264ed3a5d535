"""Four oracles on generated levels: shows that the world is sound, and what perfect modules would reach.

``python -m benchmarks.oracles --levels 512`` prints JSON: solved levels with a 95 % Wilson interval, return, steps and
instructions per episode, instructions that ran into their limit, and the steps that an instruction takes, by kind.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from mujoban_rl.stats import wilson_interval
from mujoban_sim.episodes import Episodes
from mujoban_sim.goals import GoalKind
from mujoban_sim.interfaces import Observation
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sim.sense_plan_act import SensePlanAct
from mujoban_sim.world import World


@dataclass(frozen=True)
class Options:
    """Which levels to play."""

    levels: int = 512
    difficulty: int = 5
    seed: int = 1000
    threads: int = 2


def run(options: Options | None = None) -> dict[str, Any]:
    """Play the levels in one batch until all are solved or truncated; see the module for what is returned."""
    options = options or Options()
    count = options.levels
    episodes = list(Episodes(count, options.seed, difficulty=options.difficulty))
    world = World(count, threads=options.threads)
    world.reset(np.arange(count), episodes)
    policy = SensePlanAct(OracleEstimator(), OracleTermination(), OraclePlanner(), OracleController())
    state = policy.initial_state(np.array([e.seed for e in episodes]))
    # The oracles look at no frame.
    frame = np.zeros((count, 1, 1, 3), np.uint8)
    issued, timed_out, started = np.zeros((3, count), np.int64)
    durations: dict[GoalKind, list[int]] = {kind: [] for kind in GoalKind}
    start = time.perf_counter()
    for tick in tqdm(range(world.time_limit), disable=None):
        decision, state = policy.step(Observation(frame, world.proprio, world.pose), world.truth(), state)
        live = ~world.done
        completed = decision.termination.terminated & ~decision.termination.timed_out & live
        for row in np.flatnonzero(completed):
            durations[GoalKind(world.goals.kind[row])].append(tick - int(started[row]))
        timed_out += decision.termination.timed_out & live
        issued += decision.issued & live
        started[decision.issued] = tick
        world.instruct(decision.instruction, decision.issued)
        world.step(decision.torque)
        if world.done.all():
            break
    solved = int(world.solved.sum())
    return {
        "episodes": count,
        "success_rate": solved / count,
        "success_interval": wilson_interval(solved, count),
        "mean_return": float(world.episode_return.mean()),
        "median_steps": float(np.median(world.steps)),
        "instructions": int(issued.sum()),
        "timed_out": int(timed_out.sum()),
        "steps_per_instruction": {
            kind.name.lower(): dict(zip(("median", "p95"), np.percentile(steps, [50, 95]).tolist(), strict=True))
            for kind, steps in durations.items()
            if steps
        },
        "unsolved_seeds": [e.seed for e, done in zip(episodes, world.solved, strict=True) if not done],
        "seconds": time.perf_counter() - start,
    }


if __name__ == "__main__":
    print(json.dumps(run(tyro.cli(Options, description=__doc__)), indent=2))
