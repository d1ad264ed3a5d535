"""How far a robot turns on the spot while it is told to stay: what a body that turns by its gait needs to look around.

`python -m mujoban_controller.evaluate --instructions stay` prints it; `Body.look_ticks` rests on it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.drivers import Driver
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_settings import judging_config
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.judge import OutcomeSummary
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Memory, Planner
from mujoban_sim.driving import wrap_angles
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.generator import VALIDATION_SEEDS

TICKS = (20, 40, 60, 80, 120)
"""After which it is looked how far the robots have turned."""


class StayPlanner(Planner):
    """Tells every robot to stay, for ever."""

    def initial_memory(self, batch: int) -> Memory:
        """Return nothing to remember."""
        return ()

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return STAY for each of M robots, [M]."""
        return np.full(len(abstract_state), int(Instruction.STAY), np.int64), memory


def judge_turning(
    driver: Driver,
    *,
    episodes: int,
    first_seed: int = VALIDATION_SEEDS.start,
    difficulty: int = 5,
    body: str = "ball",
    world: str = DEFAULT_WORLD,
    threads: int = 1,
) -> dict[str, Any]:
    """Play the first ticks of episodes in which the robot is told to stay, and nothing else.

    Args:
        driver: What drives, see `mujoban_controller.drivers`.
        episodes: Levels, all played at once, with seeds `first_seed`, `first_seed` + 1, ...
        first_seed: Seed of the first level.
        difficulty: Of the levels.
        body: Robot's body.
        world: The physical world, see `mujoban_sim.presets`.
        threads: Threads for physics.

    Returns:
        `turned`: by the number of ticks, how far the robots have turned to one side, in degrees: `median` and
        `slowest`, which nine in ten exceed; `off_middle`: how far they are from where they began, in cells, in the
        median; `instructions` (see `OutcomeSummary.report`).
    """
    task = GoalTask(
        judging_config(episodes, body, difficulty, world=world), StayPlanner(),
        SeededEpisodes(difficulty, first_seed), np.random.default_rng(first_seed), threads=threads,
    )  # fmt: skip
    summary, turned = OutcomeSummary(), np.zeros(episodes)
    pose = task.world.pose.copy()
    start = pose[:, :2].copy()
    report: dict[str, dict[str, float]] = {}
    for tick in range(1, TICKS[-1] + 1):
        summary.add(task.step(driver(task)).outcomes)
        before, pose = pose, task.world.pose.copy()
        # Where a robot has fallen another episode begins, with a heading and a place of its own.
        turned += np.where(task.first, 0.0, wrap_angles(pose[:, 2] - before[:, 2]))
        start[task.first] = pose[task.first, :2]
        if tick in TICKS:
            degrees = np.degrees(np.abs(turned))
            off = np.linalg.norm(pose[:, :2] - start, axis=1) / task.world.body.cell_size
            report[str(tick)] = {
                "median": float(np.median(degrees)),
                "slowest": float(np.percentile(degrees, 10)),
                "off_middle": float(np.median(off)),
            }
    return {"turned": report, "instructions": summary.report()}
