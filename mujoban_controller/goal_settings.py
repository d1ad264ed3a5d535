"""Settings of the goal task, for learning and for judging."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from mujoban_controller.goal_rewards import RewardConfig
from mujoban_controller.instructions import EXACT, InstructionConfig, TerminationConfig
from mujoban_core.bodies import get_body
from mujoban_core.grid import COMPLETION_TOLERANCE, DIFFICULTIES
from mujoban_core.ranges import check_counts, check_not_negative, check_shares
from mujoban_sim.presets import DEFAULT_WORLD, get_world


@dataclass(frozen=True)
class GoalTaskConfig:
    """Settings of the goal task."""

    batch: int = 128
    """B, robots."""
    body: str = "ball"
    """The robot's body, by name."""
    world: str = DEFAULT_WORLD
    """The physical world: reference or eased."""
    difficulty: int = 5
    """Difficulty of the generated levels, 1 to 5."""
    tolerance: float = 0.08
    """Completion tolerance in cells; tighter than the paper's 0.1, so that evaluation leaves a margin."""
    planned: float = 0.7
    """Share of episodes that follow the planner."""
    astray: float = 0.04
    """Chance that a random instruction takes the place of a planned one."""
    horizon: float = 300.0
    """Mean steps of an episode, exponentially distributed. Short ones show more levels and appearances, without
    which a camera policy knows the warehouses that it is in by heart; `inf` goes on until the level is solved."""
    look: int = 0
    """Ticks at an episode's start in which the robot is told to stay and turns, as in a look around (see
    `Body.look_ticks`). Who does not feel its heading may know it but for quarter turns until it has seen the sky."""
    retry: float = 0.0
    """Share of episodes that begin where a feasible instruction failed before, in the same appearance. Failures get
    rare long before they are few enough, and the same one then comes again and again in the level that has it."""
    patience: int = 3
    """Instructions that fail in a row before the episode is given up, since a jammed box stays jammed."""
    misaligned: float = 0.5
    """Share of episodes that begin with robot and boxes off the centres of their cells."""
    robot_offset: float = 0.25
    """Largest such offset of a robot in cells; towards a free cell, or a box that it can push, it is up to half a cell,
    where a robot that left its lane is held up by a peg. A policy that has not begun there presses on."""
    box_offset: float = 0.1
    """Largest such offset of a box, along one axis; across it it is less than half of that."""
    overshoot: float = 0.11
    """Cells past its target at which a pushed box fails the instruction at once, as does one that has come to rest
    past it: it cannot be pulled back. Saves the time that a policy that still learns would spend there."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    instructions: InstructionConfig = field(default_factory=InstructionConfig)
    terminations: TerminationConfig = field(default_factory=TerminationConfig)

    def __post_init__(self) -> None:
        """Reject settings that contradict each other."""
        get_world(self.world)
        check_counts(self, "batch", "patience")
        check_shares(self, "planned", "astray", "retry", "misaligned", "robot_offset", "box_offset")
        check_not_negative(self, "look")
        for name in ("horizon", "overshoot"):  # `inf` is never
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: expected a number above 0")
        if self.difficulty not in DIFFICULTIES:
            raise ValueError(f"difficulty is {self.difficulty}: expected one of {sorted(DIFFICULTIES)}")
        if not 0.0 < self.tolerance <= COMPLETION_TOLERANCE:
            raise ValueError(f"tolerance is {self.tolerance}: expected at most the evaluation's {COMPLETION_TOLERANCE}")


def judging_config(
    batch: int, body: str = "ball", difficulty: int = 5, *, world: str = DEFAULT_WORLD, plans: bool = True
) -> GoalTaskConfig:
    """Return the settings under which controllers are judged: exact signals and the planner's instructions.

    Who does not feel its heading begins with a look around. Without `plans` they are random ones of every kind, and an
    episode ends after 1,000 steps on average.
    """
    return GoalTaskConfig(
        batch=batch,
        body=body,
        world=world,
        difficulty=difficulty,
        tolerance=COMPLETION_TOLERANCE,
        planned=float(plans),
        astray=0.0,
        horizon=math.inf if plans else 1000.0,
        look=get_body(body).seeking_ticks,
        misaligned=0.0,
        overshoot=math.inf,
        patience=12,
        instructions=InstructionConfig(stay=0.1, infeasible=0.2, stays_on=0.0),
        terminations=EXACT,
    )
