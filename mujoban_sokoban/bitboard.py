"""Sets of cells as 64-bit integers: what may be walked and pushed, for the rules, the generator and the solver.

Outer walls are closed, so whatever happens in a level happens in the 8 x 8 cells within the outermost ring of the
grid: bit 8 (row - 1) + (column - 1) stands for cell (row, column). A *square* is such a bit's index. All sets are
`np.uint64`, since numba turns a mixture of signed and unsigned integers into floats.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from mujoban_core.grid import GRID_SIZE

SIDE: Final = GRID_SIZE - 2
"""Rows and columns of the board."""
SQUARES: Final = SIDE * SIDE

Bits = np.uint64
"""A set of squares."""
Int = int | np.integer[Any]
"""An integer of numba code, where Python's and NumPy's are one."""

NONE: Final = np.uint64(0)
ONE: Final = np.uint64(1)
_STEP: Final = np.uint64(SIDE)
_WEST_EDGE: Final = np.uint64(0x0101010101010101)
_EAST_EDGE: Final = np.uint64(0x8080808080808080)
_NORTH_EDGE: Final = np.uint64(0xFF)
_SOUTH_EDGE: Final = np.uint64(0xFF << 56)

SQUARE_STEP: Final[NDArray[np.int64]] = np.array([-SIDE, 1, SIDE, -1], np.int64)
"""Change of a square's index for a step north, east, south or west; valid only where the step stays on the board."""


def _lowest(typing_context: Any, bits: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), codegen


def _count(typing_context: Any, bits: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.int64(types.uint64), codegen


lowest = cast(Callable[[Bits], int], intrinsic(_lowest))
"""Return the lowest square of a set that is not empty; for numba code."""
count = cast(Callable[[Bits], int], intrinsic(_count))
"""Return the number of squares in a set; for numba code."""


@njit(cache=True, nogil=True, inline="always")
def bit(square: Int) -> Bits:
    """Return the set of one square."""
    return ONE << np.uint64(square)


@njit(cache=True, nogil=True)
def shift(bits: Bits, direction: Int) -> Bits:
    """Move a set one square north (0), east (1), south (2) or west (3); what leaves the board is lost."""
    if direction == 0:
        return bits >> _STEP
    if direction == 1:
        return (bits & ~_EAST_EDGE) << ONE
    if direction == 2:
        return bits << _STEP
    return (bits & ~_WEST_EDGE) >> ONE


@njit(cache=True, nogil=True)
def spread(bits: Bits) -> Bits:
    """Return a set and its four-neighbours."""
    return bits | (bits >> _STEP) | (bits << _STEP) | ((bits & ~_EAST_EDGE) << ONE) | ((bits & ~_WEST_EDGE) >> ONE)


@njit(cache=True, nogil=True)
def flood(start: Bits, free: Bits) -> Bits:
    """Return the squares of `free` that are connected to `start`, and `start`."""
    reached = start
    while True:
        grown = reached | (spread(reached) & free)
        if grown == reached:
            return reached
        reached = grown


@njit(cache=True, nogil=True, inline="always")
def pushable(stands: Bits, free: Bits, boxes: Bits, direction: Int) -> Bits:
    """Return the boxes that can be pushed in a direction: from a square of `stands` behind them into one of `free`."""
    return shift(stands, direction) & boxes & shift(free, (direction + 2) % 4)


@njit(cache=True, nogil=True, inline="always")
def stepped(stands: Bits, free: Bits, boxes: Bits, direction: Int) -> Bits:
    """Return where a robot comes to from one of `stands` by a step in a direction, onto free squares or by a push."""
    return (shift(stands, direction) & free) | pushable(stands, free, boxes, direction)


@njit(cache=True, nogil=True, inline="always")
def pushed(boxes: Bits, square: Int, direction: Int) -> Bits:
    """Return the boxes after the one on a square was pushed."""
    return (boxes ^ bit(square)) | bit(square + SQUARE_STEP[direction])


@njit(cache=True, nogil=True)
def frozen(boxes: Bits, wall: Bits, dead: Bits) -> Bits:
    """Return the boxes that can never move again.

    The greatest set in which each box is blocked along both axes by a wall or a box of the set on either side, or by
    dead squares on both sides (from which a box never reaches a target, so it is not pushed there).
    """
    blocked_h = (wall << ONE) | _WEST_EDGE | (wall >> ONE) | _EAST_EDGE | ((dead << ONE) & (dead >> ONE))
    blocked_v = (wall << _STEP) | _NORTH_EDGE | (wall >> _STEP) | _SOUTH_EDGE | ((dead << _STEP) & (dead >> _STEP))
    stuck = boxes
    while True:
        h = ((stuck & ~_EAST_EDGE) << ONE) | ((stuck & ~_WEST_EDGE) >> ONE)
        v = (stuck << _STEP) | (stuck >> _STEP)
        still = stuck & (blocked_h | h) & (blocked_v | v)
        if still == stuck:
            return stuck
        stuck = still


@njit(cache=True, nogil=True)
def from_grid(grid: NDArray[np.bool_]) -> Bits:
    """Return the inner cells of a bool grid [N, N] that are true."""
    bits = NONE
    for square in range(SQUARES):
        if grid[square // SIDE + 1, square % SIDE + 1]:
            bits |= bit(square)
    return bits


@njit(cache=True, nogil=True, inline="always")
def on_board(row: Int, col: Int) -> bool:
    """Return whether a cell of the grid has a square."""
    return bool(1 <= row <= SIDE and 1 <= col <= SIDE)


@njit(cache=True, nogil=True)
def to_square(row: Int, col: Int) -> Int:
    """Return the square of a cell of the grid."""
    return (row - 1) * SIDE + col - 1


@njit(cache=True, nogil=True)
def squares_of(cells: NDArray[np.int64]) -> Bits:
    """Return the set of (row, column) cells [K, 2]; those that are not on the board are absent."""
    bits = NONE
    for k in range(len(cells)):
        if on_board(cells[k, 0], cells[k, 1]):
            bits |= bit(to_square(cells[k, 0], cells[k, 1]))
    return bits
