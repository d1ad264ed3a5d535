"""What the world derives from physics after every step, compiled and in one pass over the batch.

`mujoban_sim.world.World` documents the arrays. Shapes: B robots, K boxes, P proprioceptive values, M selected rows.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numba.core import types
from numba.experimental import structref
from numpy.typing import NDArray

from mujoban_core.bodies import INERTIAL_SIZE, UP_AXIS_SIZE
from mujoban_core.grid import AGENT, BOX, GRID_SIZE
from mujoban_sim.goals import is_completed
from mujoban_sim.scene import BOX_COORDINATES
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD

_HALF: Final = (GRID_SIZE - 1) / 2


class KernelState(NamedTuple):
    """What `update` reads and, from `reached` on, writes; `World` and its `GoalTracker` document most of it."""

    qpos: NDArray[np.float64]
    """Generalised positions in the layout of `mujoban_sim.scene`, [B, nq]."""
    qvel: NDArray[np.float64]
    """Generalised velocities, [B, nv]."""
    sensors: NDArray[np.float64]
    """Inertial sensors in the order of proprioception, [B, 9]."""
    root: int
    """Offset of the robot's coordinates in `qpos` and in `qvel`."""
    free_root: bool
    """Whether the robot's root is a free joint, see `mujoban_core.bodies`."""
    joint_qpos: NDArray[np.int64]
    """Offsets of the proprioceptive joints among the robot's positions, [J]."""
    joint_qvel: NDArray[np.int64]
    """The same among its velocities, [J]."""
    cell_size: float
    time_limit: int
    box_count: NDArray[np.int64]
    target: NDArray[np.bool_]
    kind: NDArray[np.int64]
    robot_target: NDArray[np.float64]
    box_index: NDArray[np.int64]
    box_target: NDArray[np.float64]
    tolerance: float
    max_box_speed: float
    reached: NDArray[np.bool_]
    pose: NDArray[np.float32]
    velocity: NDArray[np.float32]
    proprio: NDArray[np.float32]
    box_position: NDArray[np.float32]
    box_speed: NDArray[np.float32]
    agent_cell: NDArray[np.int64]
    box_cell: NDArray[np.int64]
    box_on_target: NDArray[np.bool_]
    boxes_on_target: NDArray[np.int64]
    abstract_state: NDArray[np.float32]
    reward: NDArray[np.float32]
    episode_return: NDArray[np.float32]
    steps: NDArray[np.int64]
    solved: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


@structref.register
class _StateType(types.StructRef):
    """Numba's type of a packed `KernelState`."""


class _PackedState(structref.StructRefProxy):
    """A packed `KernelState`."""


structref.define_proxy(_PackedState, _StateType, KernelState._fields)


@njit(cache=True)
def pack(state: KernelState) -> KernelState:
    """Return a state as `update` takes it: by reference, since passing its fields would take as long as the work."""
    return _PackedState(*state)  # pyright: ignore[reportReturnType] - it has the same fields


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
    """Fill position [K, 2], speed [K], cell [K, 2] and on_target [K] of a world's boxes; return how many pads have one.

    At least half of a box, in both axes, lies within a pad exactly when its centre does, so the pad that counts is that
    of the box's cell. The centres of two boxes fit into one cell, side by side: the second one counts for nothing.
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
            total += int(on and not _is_among(row, col, cell[:k]))
        else:
            cell[k, 0] = cell[k, 1] = -1
            on = False
        on_target[k] = on
    return total


@njit(cache=True, nogil=True)
def _is_among(row: int, col: int, cells: NDArray[np.int64]) -> bool:
    found = False
    for k in range(cells.shape[0]):
        found |= cells[k, 0] == row and cells[k, 1] == col
    return found


@njit(cache=True, nogil=True)
def _locate_agent(
    x: float, y: float, cell_size: float, box_cell: NDArray[np.int64], agent_cell: NDArray[np.int64]
) -> None:
    """Update the agent's cell [2]; one that rounds into a box's cell keeps its last cell."""
    row, col = _cell(x, y, cell_size)
    if _is_among(row, col, box_cell):
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
def update(rows: NDArray[np.int64], advance: bool, state: KernelState) -> bool:
    """Derive everything that `World` shows of the given rows, [M], from physics; return whether an episode ended.

    `advance` says whether to count a step and give rewards, as after physics has advanced. The state is packed.
    """
    ended, root, cell_size = False, state.root, state.cell_size
    for b in rows:
        qpos, qvel = state.qpos[b], state.qvel[b]
        _observe_robot(
            qpos[root:], qvel[root:], state.sensors[b], state.free_root, state.joint_qpos, state.joint_qvel,
            state.pose[b], state.velocity[b], state.proprio[b],
        )  # fmt: skip
        _mark(state.abstract_state[b], state.agent_cell[b], state.box_cell[b], 0.0)
        before = state.boxes_on_target[b]
        state.boxes_on_target[b] = _observe_boxes(
            qpos, qvel, cell_size, int(state.box_count[b]), state.target[b],
            state.box_position[b], state.box_speed[b], state.box_cell[b], state.box_on_target[b],
        )  # fmt: skip
        _locate_agent(qpos[root], qpos[root + 1], cell_size, state.box_cell[b], state.agent_cell[b])
        _mark(state.abstract_state[b], state.agent_cell[b], state.box_cell[b], 1.0)
        k = int(BOX_COORDINATES * state.box_index[b])
        state.reached[b] = is_completed(
            int(state.kind[b]), state.robot_target[b], state.box_target[b], (qpos[root], qpos[root + 1]),
            (qpos[k], qpos[k + 1]), float(np.hypot(qvel[k], qvel[k + 1])), state.tolerance, state.max_box_speed,
        )  # fmt: skip
        if not advance:
            continue
        state.steps[b] += 1
        state.solved[b] = state.boxes_on_target[b] == state.box_count[b]
        state.truncated[b] = state.steps[b] >= state.time_limit and not state.solved[b]
        placed = state.boxes_on_target[b] - before
        state.reward[b] = placed * BOX_REWARD + (SOLVED_REWARD if state.solved[b] else 0.0)
        state.episode_return[b] += state.reward[b]
        ended |= bool(state.solved[b] or state.truncated[b])
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
