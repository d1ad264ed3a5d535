"""What the critic and a privileged teacher see: the goal, the boxes and the walls around (paper C.3).

Everything is turned into the frame of the instruction, whose x-axis is the instructed direction and whose
y-axis points to its left, and scaled by the cell, so that one policy serves all directions and bodies.

Shapes: B robots, K boxes, P proprioceptive values, D features.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_core.grid import GRID_SIZE, INSTRUCTION_AXES, OFFSETS_XY, cell_to_xy, turn_to_instruction, xy_to_cell
from mujoban_sim.goals import GoalKind, GoalTracker

_NEIGHBOURS = np.array([[x, y] for x in (-1, 0, 1, 2) for y in (-1, 0, 1) if (x, y) != (0, 0)], np.float64)
"""Cells around the origin cell whose contents matter, (along, left), [11, 2]."""
GOAL_SIZE = 4
"""Values of `goal_offsets`."""


class GoalView(Protocol):
    """What the features are made of: a `World`, or ticks of a recording."""

    batch: int
    body: Body
    goals: GoalTracker
    wall: NDArray[np.bool_]
    proprio: NDArray[np.float32]
    pose: NDArray[np.float32]
    velocity: NDArray[np.float32]
    box_position: NDArray[np.float32]
    box_speed: NDArray[np.float32]
    box_cell: NDArray[np.int64]


def feature_size(proprio_size: int) -> int:
    """Return D for a body with P proprioceptive values."""
    return proprio_size + 2 + 3 + GOAL_SIZE + (len(GoalKind) - 1) + 3 + 2 + 2 * len(_NEIGHBOURS) + 1


def _turn(v: NDArray[np.floating], axis: NDArray[np.float64]) -> NDArray[np.floating]:
    return np.stack(turn_to_instruction(v[..., 0], v[..., 1], axis[..., 0], axis[..., 1]), -1)


def goal_offsets(world: GoalView) -> NDArray[np.float32]:
    """Return, in the instruction's frame and in cells, robot to target and pushed box to target, [B, 4].

    The box's offset is zero unless the goal is a push.
    """
    goals, rows = world.goals, np.arange(world.batch)
    axis = INSTRUCTION_AXES[goals.direction]
    robot = _turn(goals.robot_target - world.pose[:, :2], axis)
    box = _turn(goals.box_target - world.box_position[rows, goals.box_index], axis)
    box[goals.kind != GoalKind.PUSH] = 0.0
    return (np.concatenate([robot, box], 1) / world.body.cell_size).astype(np.float32)


def privileged_features(world: GoalView, elapsed: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the critic's view of the state, [B, D].

    Args:
        world: Its `goals` are the instructions in force.
        elapsed: Share of the instruction's time limit that has passed, [B].
    """
    goals, rows, size = world.goals, np.arange(world.batch), world.body.cell_size
    axis = INSTRUCTION_AXES[goals.direction]
    push = (goals.kind == GoalKind.PUSH)[:, None]
    heading = np.stack([np.cos(world.pose[:, 2]), np.sin(world.pose[:, 2])], 1)
    box = world.box_position[rows, goals.box_index]
    parts = [
        np.clip(world.proprio / 5.0, -3.0, 3.0),
        _turn(heading, axis),
        _turn(world.velocity[:, :2] / size, axis),
        world.velocity[:, 2:] / 5.0,
        2.0 * goal_offsets(world),
        np.eye(len(GoalKind) - 1)[np.minimum(goals.kind, GoalKind.HOLD)],
        np.where(push, _turn(box - world.pose[:, :2], axis) / size, 0.0),
        np.where(push, world.box_speed[rows, goals.box_index][:, None] / size, 0.0),
        2.0 * _turn(world.pose[:, :2] - cell_to_xy(goals.origin_cell, size), axis) / size,
        _surroundings(world, axis),
        elapsed[:, None],
    ]
    return np.concatenate(parts, 1).astype(np.float32)


def _surroundings(world: GoalView, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return whether a wall, and whether a box, is in each of the cells around the origin cell, [B, 22]."""
    rows = np.arange(world.batch)[:, None]
    origin, left = cell_to_xy(world.goals.origin_cell), np.stack([-along[:, 1], along[:, 0]], 1)
    around = origin[:, None] + _NEIGHBOURS[:, :1] * along[:, None] + _NEIGHBOURS[:, 1:] * left[:, None]
    cells = np.clip(xy_to_cell(around), 0, GRID_SIZE - 1)
    wall = world.wall[rows, cells[..., 0], cells[..., 1]]
    box = (cells[:, :, None] == world.box_cell[:, None]).all(-1).any(-1)
    return np.concatenate([wall, box], 1).astype(np.float64)


def drift(world: GoalView, slack: float = 0.04) -> NDArray[np.float64]:
    """Return how far boxes stand off the middle of their cells, or of the lane along which one is pushed, [B].

    In cells, summed over boxes and axes, beyond `slack`. A box that coasts past a centre across its next push
    catches a peg, which is the main cause of lost episodes.
    """
    goals, size = world.goals, world.body.cell_size
    present = (world.box_cell >= 0).all(-1)
    off = np.abs(world.box_position - cell_to_xy(world.box_cell, size)) / size
    off[~present] = 0.0
    pushing = np.flatnonzero(goals.kind == GoalKind.PUSH)
    across = np.abs(OFFSETS_XY[goals.direction[pushing]]) < 0.5
    off[pushing, goals.box_index[pushing]] *= across
    return np.maximum(off - slack, 0.0).sum((1, 2))
