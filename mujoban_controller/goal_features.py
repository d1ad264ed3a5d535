"""What the critic and a privileged teacher see: robot, goal, boxes and walls around (paper C.3).

Lengths are in cells, and everything is seen from two frames: the *instruction's*, whose x-axis is the instructed
direction and whose y-axis points to its left, and the *robot's*, whose x-axis is its heading. So one policy serves all
directions. Mirroring the features (`FeatureLayout.mirror`) gives what the mirrored robot sees.

Shapes: B robots, K boxes, J joints, U actuators, D features.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.goal_view import GoalView
from mujoban_core.bodies import Body
from mujoban_core.grid import GRID_SIZE, INSTRUCTION_AXES, OFFSETS_XY, cell_to_xy, turn_to_instruction, xy_to_cell
from mujoban_sim.driving import wrap_angles
from mujoban_sim.goals import GoalKind
from mujoban_sim.scene import FOOT_FRICTION

_NEIGHBOURS = np.array([[x, y] for x in (-1, 0, 1, 2) for y in (-1, 0, 1) if (x, y) != (0, 0)], np.float64)
"""Cells around the origin cell whose contents matter, (along, left), [11, 2]."""
_MIRRORED_NEIGHBOURS = [int((n * [1, -1] == _NEIGHBOURS).all(1).argmax()) for n in _NEIGHBOURS]
GOAL_SIZE = 4
"""Values of `goal_offsets`."""
_NEAR = 5.0
"""Offsets are told a second time, that much larger and limited to [-1, 1]: what matters is the last tenth of a cell."""
_GRAVITY = 9.81


class Rearrangement(NamedTuple):
    """Entry i of a vector as it is seen is `sign[i]` times entry `source[i]`."""

    source: NDArray[np.int64]
    sign: NDArray[np.float32]


class FeatureLayout(NamedTuple):
    """Size and symmetry of the privileged features and of actions."""

    size: int
    """D."""
    mirror: Rearrangement
    """Of the features, [D]."""
    mirror_action: Rearrangement
    """Of the actions, [U]."""
    holds: int
    """Where it stands that the robot is to hold."""


_FLIP_Y = (1.0, -1.0)
# Reflections at the x-z plane turn an angular velocity's x and z, and a velocity's y.
_VECTOR, _ROTATION = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)


@cache
def feature_layout(body: Body) -> FeatureLayout:
    """Return the layout for a body."""
    source, sign = (np.array(v) for v in body.mirror)
    posture = np.flatnonzero([r is not None for r in body.joint_range])
    acting, acting_sign = (np.array(v) for v in body.mirrored_actuators)
    # The order of `privileged_features`: (source, sign) of each block.
    blocks: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = [
        (np.array([np.flatnonzero(posture == s)[0] for s in source[posture]], np.int64), sign[posture]),
        (source, sign),
        (acting, acting_sign),
    ]
    plain = [_VECTOR, _ROTATION, _VECTOR, *[_FLIP_Y] * 12, (1.0,), (1.0, 1.0, 1.0), (1.0,)]
    blocks += [(np.arange(len(s)), np.array(s)) for s in plain]
    blocks += [(np.array(_MIRRORED_NEIGHBOURS), np.ones(len(_NEIGHBOURS)))] * 2
    start, sources = 0, []
    for block, _ in blocks:
        sources.append(start + block)
        start += len(block)
    mirror = Rearrangement(np.concatenate(sources), np.concatenate([s for _, s in blocks]).astype(np.float32))
    holds = start - 2 * len(_NEIGHBOURS) - 2  # the last of the goal's kinds, behind which the elapsed time stands
    return FeatureLayout(start, mirror, Rearrangement(acting, acting_sign.astype(np.float32)), holds)


def _turn(v: NDArray[np.floating], axis: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return vectors, [..., 2], in the frame whose x-axis is `axis`."""
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


def course_error(world: GoalView) -> NDArray[np.floating]:
    """Return by how much robots would have to turn to their left to face where they are told to go, [B] radians."""
    along = INSTRUCTION_AXES[world.goals.direction]
    return wrap_angles(np.arctan2(along[:, 1], along[:, 0]) - world.pose[:, 2])


def rest_position(world: GoalView) -> NDArray[np.float64]:
    """Return where the pushed boxes will come to rest if they coast along the instruction, in metres, [B, 2]."""
    goals, rows = world.goals, np.arange(world.batch)
    speed = world.box_speed[rows, goals.box_index].astype(np.float64)
    coast = speed**2 / (2 * FOOT_FRICTION * _GRAVITY)
    return world.box_position[rows, goals.box_index].astype(np.float64) + coast[:, None] * OFFSETS_XY[goals.direction]


def privileged_features(
    world: GoalView, elapsed: NDArray[np.float64], torque: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the view of critic and teacher, [B, D].

    Args:
        world: Its `goals` are the instructions in force.
        elapsed: Share of the instruction's time limit that has passed, [B].
        torque: Applied in the tick before, [B, U].
    """
    body, goals, rows, size = world.body, world.goals, np.arange(world.batch), world.body.cell_size
    at, felt, heading = body.proprio, world.proprio, world.pose[:, 2]
    ahead = np.stack([np.cos(heading), np.sin(heading)], 1)
    lane, error = INSTRUCTION_AXES[goals.direction], course_error(world)
    push = (goals.kind == GoalKind.PUSH)[:, None]
    box = world.box_position[rows, goals.box_index].astype(np.float64)
    to_target = (goals.robot_target - world.pose[:, :2]) / size
    to_box = np.where(push, (box - world.pose[:, :2]) / size, 0.0)
    box_left = np.where(push, (goals.box_target - box) / size, 0.0)
    rest_left = np.where(push, (goals.box_target - rest_position(world)) / size, 0.0)
    vectors = [to_target, to_box, box_left, rest_left]
    parts = [
        _posture(body, felt),
        felt[:, at.joint_velocity],
        torque,
        felt[:, at.linear_velocity] / size,
        felt[:, at.angular_velocity],
        felt[:, at.up_axis],
        np.stack([np.cos(error), np.sin(error)], 1),
        *(_turn(v, ahead) for v in vectors),
        *(_turn(v, lane) for v in vectors[:3]),
        *(np.clip(_NEAR * _turn(v, lane), -1.0, 1.0) for v in (to_target, to_box, box_left, rest_left)),
        np.where(push, world.box_speed[rows, goals.box_index][:, None] / size, 0.0),
        np.eye(len(GoalKind) - 1)[np.minimum(goals.kind, GoalKind.HOLD)],
        elapsed[:, None],
        _surroundings(world),
    ]
    return np.concatenate(parts, 1).astype(np.float32)


def _posture(body: Body, felt: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the positions of joints that have a range, from -1 to 1 within it."""
    kept = [j for j, limits in enumerate(body.joint_range) if limits is not None]
    low, high = np.array([limits for limits in body.joint_range if limits is not None]).reshape(-1, 2).T
    return (2.0 * felt[:, body.proprio.joint_position][:, kept] - low - high) / (high - low)


NEIGHBOURS: Final = len(_NEIGHBOURS)
"""Cells of `neighbour_cells`."""


def neighbour_cells(world: GoalView) -> NDArray[np.int64]:
    """Return the cells around the origin cell, in the instruction's order, (row, column), [B, NEIGHBOURS, 2].

    Those beyond the board are the nearest on it.
    """
    along = INSTRUCTION_AXES[world.goals.direction]
    origin, left = cell_to_xy(world.goals.origin_cell), np.stack([-along[:, 1], along[:, 0]], 1)
    around = origin[:, None] + _NEIGHBOURS[:, :1] * along[:, None] + _NEIGHBOURS[:, 1:] * left[:, None]
    return np.clip(xy_to_cell(around), 0, GRID_SIZE - 1)


def _surroundings(world: GoalView) -> NDArray[np.float64]:
    """Return whether a wall, and whether a box, is in each of the cells around the origin cell, [B, 22]."""
    rows, cells = np.arange(world.batch)[:, None], neighbour_cells(world)
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
