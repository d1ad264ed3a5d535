"""The one place for the conventions of the Sokoban grid and the map frame.

Frames follow REP 103 and REP 105: ``map`` has x east, y north, z up, its origin at the centre of the
padded grid, and yaw counter-clockwise from east. Row 0 of every grid array is the northernmost row and
column 0 the westernmost, as in a level text.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

GRID_SIZE: Final = 10
"""Rows and columns of the padded grid, outer wall included (paper appendix B, Table 3)."""

CHANNELS: Final = ("wall", "target", "agent", "box")
"""Order of the last axis of an abstract state (paper appendix B)."""
WALL, TARGET, AGENT, BOX = range(4)

CELL_SIZE: Final = 1.0
"""Edge of a cell in metres for the ball body; bodies of other size scale it (paper A.3)."""

CONTROL_PERIOD: Final = 0.05
"""Seconds between two torques: 20 Hz (paper appendix B)."""
FASTEST: Final = 1000.0
"""Most simulated seconds per second that a run may be paced at."""
TIME_LIMIT: Final = 4800
"""Steps of an episode: 240 s (paper C.5)."""
INSTRUCTION_LIMIT: Final = 120
"""Steps within which an instruction has to be completed, T_instr (paper C.3)."""
COMPLETION_TOLERANCE: Final = 0.1
"""Distance, in cells, within which agent or box counts as being at a cell's centre (paper C.4)."""

DIFFICULTIES: Final[dict[int, tuple[int, int]]] = {1: (5, 1), 2: (7, 1), 3: (7, 2), 4: (8, 3), 5: (10, 4)}
"""Difficulty -> (grid size counting the outer wall, number of boxes) (paper Table 3)."""
MAX_BOXES: Final = max(boxes for _, boxes in DIFFICULTIES.values())
"""Of a generated level: K where levels of all difficulties are played in one world."""


class Instruction(IntEnum):
    """An abstract instruction A (paper section 2); the order is that of every policy output."""

    STAY = 0
    NORTH = 1
    EAST = 2
    SOUTH = 3
    WEST = 4


OFFSETS_RC: Final[NDArray[np.int64]] = np.array([[0, 0], [-1, 0], [0, 1], [1, 0], [0, -1]], dtype=np.int64)
"""(row, column) step of each instruction, [5, 2]."""
OFFSETS_XY: Final[NDArray[np.float64]] = np.array(
    [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]], dtype=np.float64
)
"""Unit step in the map frame of each instruction, [5, 2]."""

INSTRUCTION_AXES: Final[NDArray[np.float64]] = np.where(OFFSETS_XY.any(1, keepdims=True), OFFSETS_XY, (1.0, 0.0))
"""x-axis, in the map frame, of the frame in which each instruction points along +x, [5, 2]; stay's points east."""

_HALF: Final = (GRID_SIZE - 1) / 2


class Arithmetic(Protocol):
    """An array or a tensor."""

    def __add__(self, other: Self, /) -> Self: ...
    def __sub__(self, other: Self, /) -> Self: ...
    def __mul__(self, other: Self, /) -> Self: ...


Values = TypeVar("Values", bound=Arithmetic)


def turn_to_instruction(x: Values, y: Values, axis_x: Values, axis_y: Values) -> tuple[Values, Values]:
    """Return vectors of the map in the frame of an instruction: (along it, to its left).

    Args:
        x: East, arrays or tensors of any shape.
        y: North.
        axis_x: East of the instruction's row of `INSTRUCTION_AXES`; broadcast.
        axis_y: North of it.
    """
    return x * axis_x + y * axis_y, y * axis_x - x * axis_y


def robot_cells(abstract_state: NDArray[Any]) -> NDArray[np.int64]:
    """Return the (row, column) in which the robot is most likely, [..., 2], given s_abst, [..., N, N, 4]."""
    layer = abstract_state[..., AGENT]
    return np.stack(np.divmod(layer.reshape(*layer.shape[:-2], -1).argmax(-1), layer.shape[-1]), -1)


def cell_to_xy(cell: ArrayLike, cell_size: float = CELL_SIZE) -> NDArray[np.float64]:
    """Return the centres, in metres in the map frame, of cells given as (row, column), [..., 2]."""
    rc = np.asarray(cell, dtype=np.float64)
    return np.stack([rc[..., 1] - _HALF, _HALF - rc[..., 0]], axis=-1) * cell_size


def xy_to_cell(xy: ArrayLike, cell_size: float = CELL_SIZE) -> NDArray[np.int64]:
    """Return the (row, column) of the cells nearest to map positions in metres, [..., 2]; not clipped."""
    p = np.asarray(xy, dtype=np.float64) / cell_size
    return np.stack([np.rint(_HALF - p[..., 1]), np.rint(p[..., 0] + _HALF)], axis=-1).astype(np.int64)
