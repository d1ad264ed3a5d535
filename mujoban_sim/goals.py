"""The completion rule of an abstract instruction (paper C.4): the only place where it stands.

An instruction issued in cell c towards its neighbour d is

- a *move* when d is free: completed when the robot is within `tolerance` of d's centre;
- a *push* when d holds a box and the cell e behind d is free: completed when that box is within `tolerance`
  of e's centre and slower than `max_box_speed` (a refinement of the paper's rule, which knows no speed: a box
  that coasts past a centre catches a peg on its next push); the robot's own position does not matter;
- a *hold* otherwise (stay; or infeasible, because d is a wall or its box is blocked): completed when the robot is
  within `tolerance` of the centre of c, the cell in which it must remain.

The origin c is the cell that the instruction before led to, if that was completed; else the cell in which the
robot is. The distinction matters after a push, when the robot stands almost half a cell off c's centre.

Shapes: B robots, K boxes, N rows and columns of the grid, M selected rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.grid import CELL_SIZE, COMPLETION_TOLERANCE, Instruction, cell_to_xy
from mujoban_sokoban.rules import apply

MAX_BOX_SPEED: Final = 0.3
"""Speed in m/s (of a world with 1 m cells; scaled with the cell) below which a pushed box counts as placed."""


class GoalKind(IntEnum):
    """What an instruction asks for where it was issued."""

    MOVE = 0
    PUSH = 1
    HOLD = 2
    NONE = 3
    """No instruction has been issued in the episode yet."""


_PUSH, _NONE = int(GoalKind.PUSH), int(GoalKind.NONE)
_ARRAYS: Final = (
    "direction", "kind", "origin_cell", "goal_cell", "robot_target", "box_index", "box_target", "reached"
)  # fmt: skip


@njit(cache=True, nogil=True)
def is_completed(
    kind: int,
    robot_target: NDArray[np.float64],
    box_target: NDArray[np.float64],
    robot: tuple[float, float],
    box: tuple[float, float],
    box_speed: float,
    tolerance: float,
    max_box_speed: float,
) -> bool:
    """Return whether a goal is reached.

    Args:
        kind: A `GoalKind`.
        robot_target: Of the `GoalTracker`, [2].
        box_target: The same, [2].
        robot: Position in the map frame [m].
        box: Position of the box to be pushed [m].
        box_speed: Its speed [m/s].
        tolerance: Of the `GoalTracker` [m].
        max_box_speed: The same [m/s].
    """
    if kind == _PUSH:
        return np.hypot(box[0] - box_target[0], box[1] - box_target[1]) < tolerance and box_speed < max_box_speed
    return kind != _NONE and np.hypot(robot[0] - robot_target[0], robot[1] - robot_target[1]) < tolerance


class GoalTracker:
    """Goals of the instructions in force of B robots, and whether they are completed.

    Attributes:
        direction: `Instruction` in force, int64 [B].
        kind: `GoalKind` of each, int64 [B].
        origin_cell: cell from which the instruction counts, (row, column), int64 [B, 2].
        goal_cell: cell to which it leads the robot, int64 [B, 2].
        robot_target: centre of `goal_cell` in the map frame [m], float64 [B, 2].
        box_index: the box to be pushed, int64 [B]; 0 unless `kind` is PUSH.
        box_target: where it is to be pushed in the map frame [m], float64 [B, 2]; meaningless unless PUSH.
        reached: result of the last check by `is_completed`, bool [B], which the world makes after every step; false
            since the instruction was issued until one is made.
    """

    def __init__(
        self,
        batch: int,
        *,
        cell_size: float = CELL_SIZE,
        tolerance: float = COMPLETION_TOLERANCE,
        max_box_speed: float = MAX_BOX_SPEED,
    ) -> None:
        """Track `batch` robots; `tolerance` in cells, `max_box_speed` in cells per second (`inf`: the paper's rule).

        Raises:
            ValueError: if the tolerance or the speed is not positive.
        """
        if not (tolerance > 0 and max_box_speed > 0):
            raise ValueError(f"tolerance {tolerance} and max_box_speed {max_box_speed}: expected positive numbers")
        self.cell_size = cell_size
        self.tolerance = tolerance * cell_size
        self.max_box_speed = max_box_speed * cell_size
        self.direction = np.zeros(batch, np.int64)
        self.kind = np.full(batch, GoalKind.NONE, np.int64)
        self.origin_cell = np.zeros((batch, 2), np.int64)
        self.goal_cell = np.zeros((batch, 2), np.int64)
        self.robot_target = np.zeros((batch, 2))
        self.box_index = np.zeros(batch, np.int64)
        self.box_target = np.zeros((batch, 2))
        self.reached = np.zeros(batch, np.bool_)

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Forget the instructions of the given rows, [M], as at an episode's start."""
        self.direction[rows] = Instruction.STAY
        self.kind[rows] = GoalKind.NONE
        self.reached[rows] = False

    def begin(
        self,
        rows: NDArray[np.int64],
        direction: NDArray[np.int64],
        wall: NDArray[np.bool_],
        agent_cell: NDArray[np.int64],
        box_cell: NDArray[np.int64],
    ) -> None:
        """Put new instructions in force.

        Args:
            rows: rows that get a new instruction, int64 [M].
            direction: instructions of all rows, int64 [B]; only those of `rows` are read.
            wall: [B, N, N].
            agent_cell: the robots' cells, int64 [B, 2].
            box_cell: the boxes' cells, int64 [B, K, 2]; (-1, -1) where there is none.

        Raises:
            ValueError: if an instruction is not one of `Instruction`.
        """
        walls, boxes = wall[rows], box_cell[rows]
        origin = np.where(self.reached[rows, None], self.goal_cell[rows], agent_cell[rows])
        # Targets do not matter for where things go.
        result = apply(walls, walls, boxes, origin, direction[rows])
        # Shape [M, K].
        pushed = (result.boxes != boxes).any(-1)
        index = pushed.argmax(-1)
        self.direction[rows] = direction[rows]
        self.kind[rows] = np.where(result.moved, np.where(pushed.any(-1), _PUSH, GoalKind.MOVE), GoalKind.HOLD)
        self.origin_cell[rows] = origin
        self.goal_cell[rows] = result.player
        self.robot_target[rows] = cell_to_xy(result.player, self.cell_size)
        self.box_index[rows] = index
        self.box_target[rows] = cell_to_xy(result.boxes[np.arange(len(rows)), index], self.cell_size)
        self.reached[rows] = False

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays by name, not copied; the batch is on the first axis."""
        return {name: getattr(self, name) for name in _ARRAYS}

    def memory(self) -> tuple[NDArray[Any], ...]:
        """Return a copy of all arrays, for a module that tracks goals itself."""
        return tuple(array.copy() for array in self.arrays().values())

    def restore(self, memory: Sequence[NDArray[Any]]) -> None:
        """Take over a copy of the arrays that `memory` returned."""
        for array, values in zip(self.arrays().values(), memory, strict=True):
            array[:] = values
