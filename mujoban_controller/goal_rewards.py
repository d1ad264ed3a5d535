"""The reward of the goal task (paper C.3), the same for every body, in play and in recordings.

The paper's terms are a bonus for a completed instruction, a cost of one that failed and a small one of going
backwards. They come seldom; so progress is rewarded as well, as the change of a potential over states (Ng et al.
1999), which looks at where a pushed box will come to rest. And what loses levels later has a price: boxes that leave
the middle of their lanes jam at pegs. A robot that no single action turns on the spot learns to turn while it is told
to stay, so that its camera sees to all sides.

Shapes: B robots, U actuators.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.goal_features import GoalView, course_error, drift, rest_position
from mujoban_core.grid import CONTROL_PERIOD, OFFSETS_XY, Instruction
from mujoban_sim.driving import forward_speed
from mujoban_sim.goals import GoalKind

REACH = 0.6
"""Distance in cells from the robot to the box that it pushes, beyond which it is told to come nearer."""

_PLACE = 0.3
"""Distance in cells from the middle at which turning earns nothing. It earns less the farther off the robot is, and
not only where STAY ends: a robot that had stopped at that edge would lose all by its first step."""


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the goal task's reward; lengths in cells."""

    completed: float = 2.0
    """Reward once for an instruction that is completed."""
    failed: float = -2.0
    """Reward once for one that failed."""
    fallen: float = -4.0
    """Reward of a tick in the place of all terms, where the robot has fallen."""
    progress: float = 5.0
    """Of the potential's change."""
    lane: float = 0.3
    """Weight, in the potential, of the robot's distance from its lane."""
    gap: float = 0.5
    """Weight, in the potential, of the distance between robot and box."""
    aside: float = 4.0
    """Weight, in the potential, of the pushed box's distance from its lane."""
    drift: float = 2.0
    """Cost of each cell by which boxes leave the middle of their lanes."""
    residual: float = 15.0
    """Cost of each cell that is left between where a pushed box will rest and its target, when it is completed."""
    time: float = 0.02
    """Cost of a tick."""
    effort: float = 0.01
    """Cost of the squared change of torques."""
    heading: float = 0.05
    """Cost of a tick in which the robot looks the other way than where it is told to go."""
    tilt: float = 0.1
    """Cost of a tick in which the robot lies on its side."""
    turn: float = 5.0
    """Of each radian by which a robot that is to hold turns to its left in the middle of its cell, where no single
    action turns it: a gait has to earn more than it costs in torques, also while it is still slow."""
    fastest_turn: float = 2.0
    """Radians per second beyond which turning faster earns no more."""
    facing: float = 1.0
    """Weight, in the potential, of each half turn by which a robot that no single action turns faces away from where
    it is told to go."""
    backwards: float = 0.0
    """Cost of a tick in which the robot moves backwards."""

    def __post_init__(self) -> None:
        """Reject what is no number."""
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}: expected a finite number")


def potential(world: GoalView, config: RewardConfig) -> NDArray[np.float64]:
    """Return how near the goal in force is, in cells and not above 0, [B]."""
    goals, rows, size = world.goals, np.arange(world.batch), world.body.cell_size
    direction = OFFSETS_XY[goals.direction]
    normal = np.stack([-direction[:, 1], direction[:, 0]], 1)
    robot = world.pose[:, :2].astype(np.float64)
    to_go = (goals.robot_target - robot) / size
    move = -np.hypot(*to_go.T) - config.lane * np.abs((to_go * normal).sum(1))
    box = world.box_position[rows, goals.box_index]
    left = (goals.box_target - rest_position(world)) / size
    apart = (box - robot) / size
    push = -np.abs((left * direction).sum(1))
    push -= config.lane * np.abs((apart * normal).sum(1))
    push -= config.gap * np.maximum((apart * direction).sum(1) - REACH, 0.0)
    push -= config.aside * np.maximum(np.abs((left * normal).sum(1)) - 0.02, 0.0)
    near = np.where(goals.kind == GoalKind.PUSH, push, move)
    if world.body.turn is None:
        near -= config.facing * np.where(goals.kind == GoalKind.HOLD, 0.0, np.abs(course_error(world)) / np.pi)
    return near


class GoalReward:
    """Rewards of successive ticks; `before` a tick, then `after` it with the same goals in force."""

    def __init__(self, config: RewardConfig) -> None:
        """Weigh the terms by `config`."""
        self.config = config

    def before(self, world: GoalView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what `after` compares with: potential and drift, [B] each."""
        return potential(world, self.config), drift(world)

    def after(
        self,
        world: GoalView,
        before: tuple[NDArray[np.float64], NDArray[np.float64]],
        change: NDArray[np.float32],
        completed: NDArray[np.bool_],
        failed: NDArray[np.bool_],
    ) -> NDArray[np.float32]:
        """Return the rewards of a tick, [B].

        Args:
            world: After the tick.
            before: What `before` returned.
            change: Of the torques since the tick before, [B, U].
            completed: Where the instruction ended completed, [B].
            failed: Where it failed, [B].
        """
        c, body = self.config, world.body
        there, drifted = before
        reward = c.progress * (potential(world, c) - there)
        reward += c.completed * completed + c.failed * failed
        if body.turn is None:
            stayed = completed & (world.goals.direction == Instruction.STAY)
            reward += self._turning(world) - c.completed * stayed
        reward -= c.drift * (drift(world) - drifted)
        reward -= c.time + c.effort * np.square(change).sum(1) + c.tilt * (1.0 - upright(world))
        reward -= c.heading * self._off_course(world)
        placed = completed & (world.goals.kind == GoalKind.PUSH)
        residual = np.hypot(*(rest_position(world) - world.goals.box_target).T) / body.cell_size
        reward -= c.residual * np.where(placed, residual, 0.0)
        if c.backwards > 0.0:
            reward -= c.backwards * (forward_speed(world.pose, world.velocity, body.cell_size) < -0.05)
        return np.where(fallen(world), c.fallen, reward).astype(np.float32)

    def _turning(self, world: GoalView) -> NDArray[np.float64]:
        """Return what turning to the left earns where there is nothing else to do, [B]."""
        at, c = world.body.proprio, self.config
        turned = np.clip(at.turn_rate(world.proprio), -c.fastest_turn, c.fastest_turn) * CONTROL_PERIOD
        off = np.hypot(*(world.goals.robot_target - world.pose[:, :2]).T) / world.body.cell_size
        placed = np.maximum(1.0 - off / _PLACE, 0.0)
        return c.turn * turned * placed * (world.goals.kind == GoalKind.HOLD)

    def _off_course(self, world: GoalView) -> NDArray[np.float64]:
        """Return 0 where the robot looks along the instruction, up to 1 where it looks the other way, [B]."""
        return (1.0 - np.cos(course_error(world))) / 2 * (world.goals.kind != GoalKind.HOLD)


def upright(world: GoalView) -> NDArray[np.float32]:
    """Return the cosine of the robot's tilt, [B]."""
    return world.proprio[:, world.body.proprio.up_axis][:, 2]


def fallen(world: GoalView) -> NDArray[np.bool_]:
    """Return whether the robot lies on its side or back, [B]."""
    return upright(world) < 0.2
