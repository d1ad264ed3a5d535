"""What the world derives from physics after every step, compiled and in one pass over the batch.

`mujoban_sim.world.World` documents the arrays. Shapes: B robots, K boxes, P proprioceptive values, M selected rows.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.bodies import INERTIAL_SIZE, UP_AXIS_SIZE
from mujoban_core.grid import AGENT, BOX, GRID_SIZE
from mujoban_sim.goals import is_completed
from mujoban_sim.scene import BOX_COORDINATES
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD

_HALF: Final = (GRID_SIZE - 1) / 2


@njit(cache=True, nogil=True)
def wrap_angle(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@njit(cache=True, nogil=True)
def _cell(x: float, y: float, cell_size: float) -> tuple[int, int]:
    """Return the (row, column) of the cell nearest to a position; always one of the grid's."""
    row, col = int(np.rint(_HALF - y / cell_size)), int(np.rint(x / cell_size + _HALF))
    return min(max(row, 0), GRID_SIZE - 1), min(max(col, 0), GRID_SIZE - 1)


@njit(cache=True, nogil=True)
def _observe_robot(
    qpos: NDArray[np.float64],
    qvel: NDArray[np.float64],
    sensors: NDArray[np.float64],
    free_root: bool,
    joint_qpos: NDArray[np.int64],
    joint_qvel: NDArray[np.int64],
    pose: NDArray[np.float32],
    velocity: NDArray[np.float32],
    proprio: NDArray[np.float32],
) -> None:
    """Fill pose [3], velocity [3] and proprioception [P] of one robot from its own coordinates."""
    if free_root:
        w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
        heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        # Third row of the rotation matrix: the world's z-axis in the robot's frame.
        up = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        yaw_rate = up[0] * qvel[3] + up[1] * qvel[4] + up[2] * qvel[5]
    else:
        heading, up, yaw_rate = wrap_angle(qpos[3]), (0.0, 0.0, 1.0), qvel[3]
    pose[0], pose[1], pose[2] = qpos[0], qpos[1], heading
    velocity[0], velocity[1], velocity[2] = qvel[0], qvel[1], yaw_rate
    for i in range(INERTIAL_SIZE):
        proprio[i] = sensors[i]
    joints = len(joint_qpos)
    for j in range(joints):
        proprio[INERTIAL_SIZE + j] = wrap_angle(float(qpos[joint_qpos[j]]))
        proprio[INERTIAL_SIZE + joints + j] = qvel[joint_qvel[j]]
    for i in range(UP_AXIS_SIZE):
        proprio[INERTIAL_SIZE + 2 * joints + i] = up[i]


@njit(cache=True, nogil=True)
def _observe_boxes(
    qpos: NDArray[np.float64],
    qvel: NDArray[np.float64],
    cell_size: float,
    count: int,
    target: NDArray[np.bool_],
    position: NDArray[np.float32],
    speed: NDArray[np.float32],
    cell: NDArray[np.int64],
    on_target: NDArray[np.bool_],
) -> int:
    """Fill position [K, 2], speed [K], cell [K, 2] and on_target [K] of a world's boxes; return how many are on.

    At least half of a box, in both axes, lies within a pad exactly when its centre does, so the pad that counts is that
    of the box's cell.
    """
    total = 0
    for k in range(position.shape[0]):
        j = BOX_COORDINATES * k
        x, y = qpos[j], qpos[j + 1]
        position[k, 0], position[k, 1] = x, y
        speed[k] = np.hypot(qvel[j], qvel[j + 1])
        if k < count:
            row, col = _cell(x, y, cell_size)
            cell[k, 0], cell[k, 1] = row, col
            on = target[row, col]
        else:
            cell[k, 0] = cell[k, 1] = -1
            on = False
        on_target[k] = on
        total += int(on)
    return total


@njit(cache=True, nogil=True)
def _locate_agent(
    x: float, y: float, cell_size: float, box_cell: NDArray[np.int64], agent_cell: NDArray[np.int64]
) -> None:
    """Update the agent's cell [2]; one that rounds into a box's cell keeps its last cell (DESIGN, section 3)."""
    row, col = _cell(x, y, cell_size)
    for k in range(box_cell.shape[0]):
        if box_cell[k, 0] == row and box_cell[k, 1] == col:
            return
    agent_cell[0], agent_cell[1] = row, col


@njit(cache=True, nogil=True)
def _mark(
    abstract_state: NDArray[np.float32], agent_cell: NDArray[np.int64], box_cell: NDArray[np.int64], value: float
) -> None:
    """Write a value at the agent's cell [2] and the boxes' cells [K, 2] of an abstract state, [N, N, 4]."""
    abstract_state[agent_cell[0], agent_cell[1], AGENT] = value
    for k in range(box_cell.shape[0]):
        if box_cell[k, 0] >= 0:
            abstract_state[box_cell[k, 0], box_cell[k, 1], BOX] = value


@njit(cache=True, nogil=True)
def update(
    rows: NDArray[np.int64],
    advance: bool,
    qpos: NDArray[np.float64],
    qvel: NDArray[np.float64],
    sensors: NDArray[np.float64],
    root: int,
    free_root: bool,
    joint_qpos: NDArray[np.int64],
    joint_qvel: NDArray[np.int64],
    cell_size: float,
    time_limit: int,
    box_count: NDArray[np.int64],
    target: NDArray[np.bool_],
    kind: NDArray[np.int64],
    robot_target: NDArray[np.float64],
    box_index: NDArray[np.int64],
    box_target: NDArray[np.float64],
    tolerance: float,
    max_box_speed: float,
    completed: NDArray[np.bool_],
    pose: NDArray[np.float32],
    velocity: NDArray[np.float32],
    proprio: NDArray[np.float32],
    box_position: NDArray[np.float32],
    box_speed: NDArray[np.float32],
    agent_cell: NDArray[np.int64],
    box_cell: NDArray[np.int64],
    box_on_target: NDArray[np.bool_],
    boxes_on_target: NDArray[np.int64],
    abstract_state: NDArray[np.float32],
    reward: NDArray[np.float32],
    episode_return: NDArray[np.float32],
    steps: NDArray[np.int64],
    solved: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> bool:
    """Derive everything that `World` shows of the given rows, [M], from physics; return whether an episode ended.

    `advance` says whether to count a step and give rewards, as after physics has advanced. The robot's positions
    start at `root` in `qpos` [B, nq], its velocities at the same offset in `qvel` [B, nv]; `joint_qpos` and
    `joint_qvel`, [J], are the offsets of the proprioceptive joints. `sensors` is [B, 9]. All that follows
    `time_limit` is as in `World` and its `GoalTracker`; from `completed` on it is written.
    """
    ended = False
    for b in rows:
        _observe_robot(
            qpos[b, root:], qvel[b, root:], sensors[b], free_root, joint_qpos, joint_qvel,
            pose[b], velocity[b], proprio[b],
        )  # fmt: skip
        _mark(abstract_state[b], agent_cell[b], box_cell[b], 0.0)
        before = boxes_on_target[b]
        boxes_on_target[b] = _observe_boxes(
            qpos[b], qvel[b], cell_size, int(box_count[b]), target[b],
            box_position[b], box_speed[b], box_cell[b], box_on_target[b],
        )  # fmt: skip
        _locate_agent(qpos[b, root], qpos[b, root + 1], cell_size, box_cell[b], agent_cell[b])
        _mark(abstract_state[b], agent_cell[b], box_cell[b], 1.0)
        k = BOX_COORDINATES * box_index[b]
        robot_offset = (qpos[b, root] - robot_target[b, 0], qpos[b, root + 1] - robot_target[b, 1])
        box_offset = (qpos[b, k] - box_target[b, 0], qpos[b, k + 1] - box_target[b, 1])
        speed = float(np.hypot(qvel[b, k], qvel[b, k + 1]))
        completed[b] = is_completed(int(kind[b]), robot_offset, box_offset, speed, tolerance, max_box_speed)
        if not advance:
            continue
        steps[b] += 1
        solved[b] = boxes_on_target[b] == box_count[b]
        truncated[b] = steps[b] >= time_limit and not solved[b]
        reward[b] = (boxes_on_target[b] - before) * BOX_REWARD + (SOLVED_REWARD if solved[b] else 0.0)
        episode_return[b] += reward[b]
        ended |= bool(solved[b] or truncated[b])
    return ended


@njit(cache=True, nogil=True)
def apply_torque(torque: NDArray[np.floating], control: NDArray[np.float64]) -> bool:
    """Copy torques to the actuators, [B, U], and return true; or leave them if one is outside [-1, 1] or NaN."""
    for b in range(torque.shape[0]):
        for u in range(torque.shape[1]):
            if not abs(torque[b, u]) <= 1.0:
                return False
    control[:] = torque
    return True
