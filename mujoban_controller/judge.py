"""Judge a controller on instructions and on whole episodes of a planner's solutions.

Instruction success does not predict episode success: one box jammed at a peg loses the level. So controllers are
judged by the levels that they solve under a solver's plans, and failures are told apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mujoban_controller.drivers import Driver
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_settings import judging_config
from mujoban_controller.goal_task import EpisodeEnd, GoalTask, Outcome
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Planner
from mujoban_core.stats import wilson_interval
from mujoban_rl.metrics import COUNT
from mujoban_sim.goals import GoalKind
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.generator import VALIDATION_SEEDS


def kind_name(outcome: Outcome) -> str:
    """Return move, push, stay or blocked (an infeasible instruction)."""
    if outcome.kind == GoalKind.HOLD:
        return "stay" if outcome.direction == Instruction.STAY else "blocked"
    return outcome.kind.name.lower()


def failure_name(outcome: Outcome) -> str:
    """Return why an instruction failed: robot fallen, box off its lane, someone in a wrong cell, or time run out."""
    if outcome.fallen:
        return "fallen"
    if outcome.off_lane:
        return "box off lane"
    return "wrong cell" if outcome.wrong_cell else "time-out"


@dataclass
class OutcomeSummary:
    """Success and duration of instructions by kind."""

    ticks: dict[str, list[int]] = field(default_factory=dict)
    """Ticks of completed instructions."""
    count: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    displaced: int = 0
    """Completed instructions that left robot or boxes in wrong cells."""

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Count outcomes."""
        for outcome in outcomes:
            kind = kind_name(outcome)
            self.count[kind] += 1
            if outcome.completed:
                self.ticks.setdefault(kind, []).append(outcome.ticks)
                self.displaced += outcome.wrong_cell
            else:
                self.failures[failure_name(outcome)] += 1

    def report(self) -> dict[str, Any]:
        """Return success rate with interval, and median and 95th-percentile ticks by kind, and the failures.

        `feasible` counts all instructions but those towards walls and blocked boxes.
        """
        kinds = {}
        for kind, n in sorted(self.count.items()):
            ticks = self.ticks.get(kind, [])
            kinds[kind] = {
                "n": n,
                "success_rate": len(ticks) / n,
                "success_interval": list(wilson_interval(len(ticks), n)),
                "median_steps": float(np.median(ticks)) if ticks else None,
                "p95_steps": float(np.percentile(ticks, 95)) if ticks else None,
            }
        feasible = [kind for kind in kinds if kind != "blocked"]
        n, completed = sum(self.count[k] for k in feasible), sum(len(self.ticks.get(k, [])) for k in feasible)
        together = {"n": n, "completed": completed, "success_interval": list(wilson_interval(completed, n))}
        failures = dict(self.failures)
        return {"kinds": kinds, "feasible": together, "failures": failures, "displaced": self.displaced}

    def scalars(self) -> dict[str, float]:
        """Return rates and durations by kind, for a log."""
        values: dict[str, float] = {}
        for kind, entry in self.report()["kinds"].items():
            values[f"instruction/{kind}"] = entry["success_rate"]
            values[f"instruction/{kind}{COUNT}"] = entry["n"]
            if entry["median_steps"] is not None:
                values[f"steps/{kind}"] = entry["median_steps"]
        return values


def judge(
    driver: Driver,
    planner: Planner,
    *,
    episodes: int,
    first_seed: int = VALIDATION_SEEDS.start,
    difficulty: int = 5,
    body: str = "ball",
    world: str = DEFAULT_WORLD,
    batch: int = 64,
    threads: int = 1,
    plans: bool = True,
) -> dict[str, Any]:
    """Play episodes with a planner's instructions, or random ones, and exact termination signals.

    Args:
        driver: What drives, see `mujoban_controller.drivers`.
        planner: Gives the instructions from true abstract states.
        episodes: Levels to play, with seeds `first_seed`, `first_seed` + 1, ...
        first_seed: Seed of the first level.
        difficulty: Of the levels.
        body: Robot's body.
        world: The physical world, see `mujoban_sim.presets`.
        batch: Levels played at once.
        threads: Threads for physics.
        plans: Follow the planner; else instructions are random, towards walls and blocked boxes too, and only
            `instructions` is returned.

    Returns:
        `success_rate`, `success_interval`, `mean_return`, `median_steps`, `lost` (seeds with the last failure of
        each) and `instructions` (see `OutcomeSummary.report`).
    """
    batch = min(batch, episodes)
    task = GoalTask(
        judging_config(batch, body, difficulty, world=world, plans=plans), planner,
        SeededEpisodes(difficulty, first_seed), np.random.default_rng(first_seed), threads=threads,
    )  # fmt: skip
    last_seed = first_seed + episodes
    summary, ended, lost, last_failure = OutcomeSummary(), list[EpisodeEnd](), dict[str, str](), dict[int, str]()
    seeds = np.array([spec.seed for spec in task.world.episodes if spec is not None])
    while len(ended) < episodes:
        result = task.step(driver(task))
        counted = [o for o in result.outcomes if seeds[o.row] < last_seed]
        summary.add(counted)
        last_failure |= {o.row: failure_name(o) for o in counted if not o.completed}
        for end in result.episodes:
            failure = last_failure.pop(end.row, "time limit")
            if end.seed < last_seed:
                ended.append(end)
                if not end.solved:
                    lost[str(end.seed)] = failure
            spec = task.world.episodes[end.row]
            seeds[end.row] = last_seed if spec is None else spec.seed
    if not plans:
        return {"instructions": summary.report()}
    solved = sum(e.solved for e in ended)
    return {
        "success_rate": solved / episodes,
        "success_interval": list(wilson_interval(solved, episodes)),
        "mean_return": float(np.mean([e.episode_return for e in ended])),
        "median_steps": float(np.median([e.steps for e in ended])),
        "lost": lost,
        "instructions": summary.report(),
    }
