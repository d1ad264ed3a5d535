"""States in the forms that the planner's parts want: level batches, 64-bit boards, abstract states.

The interior of a level has 8 x 8 cells, so each layer of a state is one 64-bit board as in `mujoban_sokoban.bitboard`.

Shapes: B levels, M boards, K boxes, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE, TARGET, WALL
from mujoban_planner.symmetry import cell_sources
from mujoban_sokoban.bitboard import SIDE, SQUARES, pushed
from mujoban_sokoban.levels import LevelBatch


class BitBoards(NamedTuple):
    """States of M levels."""

    wall: NDArray[np.uint64]
    """[M]."""
    target: NDArray[np.uint64]
    """[M]."""
    box: NDArray[np.uint64]
    """[M]."""
    agent: NDArray[np.uint8]
    """Square of the robot, [M]."""


def take_levels(levels: LevelBatch, rows: NDArray[Any]) -> LevelBatch:
    """Return the given rows, by index or mask."""
    return LevelBatch(levels.wall[rows], levels.target[rows], levels.boxes[rows], levels.player[rows])


def join_levels(parts: list[LevelBatch]) -> LevelBatch:
    """Return the levels of all parts, which have as many boxes each."""
    return LevelBatch._make(np.concatenate(columns) for columns in zip(*parts, strict=True))


def abstract_states(levels: LevelBatch) -> NDArray[np.float32]:
    """Return s_abst of every level, [B, N, N, 4]."""
    state = np.zeros((*levels.wall.shape, len(CHANNELS)), np.float32)
    state[..., WALL], state[..., TARGET], state[..., BOX] = levels.wall, levels.target, _box_layer(levels)
    state[np.arange(len(levels.player)), levels.player[:, 0], levels.player[:, 1], AGENT] = 1.0
    return state


def bit_boards(levels: LevelBatch) -> BitBoards:
    """Return levels as 64-bit boards."""
    agent = (levels.player[:, 0] - 1) * SIDE + levels.player[:, 1] - 1
    box = pack_boards(_box_layer(levels))
    return BitBoards(pack_boards(levels.wall), pack_boards(levels.target), box, agent.astype(np.uint8))


def push_box(boards: BitBoards, row: int, push: int) -> None:
    """Push a box in one level, in place; the push is possible, 4 * square of the box + direction."""
    square, direction = divmod(push, 4)
    boards.box[row], boards.agent[row] = pushed(boards.box[row], square, direction), square


def level_batch(boards: BitBoards) -> LevelBatch:
    """Return states as levels; boxes in the order of their squares, K the most that any has."""
    wall = np.ones((len(boards.agent), GRID_SIZE, GRID_SIZE), np.bool_)
    target = np.zeros_like(wall)
    wall[:, 1:-1, 1:-1], target[:, 1:-1, 1:-1] = _unpack(boards.wall), _unpack(boards.target)
    level, row, column = np.nonzero(_unpack(boards.box))
    counts = np.bincount(level, minlength=len(wall))
    cells = np.full((len(wall), int(counts.max(initial=1)), 2), -1, np.int64)
    index = np.arange(len(level)) - np.repeat(np.cumsum(counts) - counts, counts)
    cells[level, index] = np.stack([row + 1, column + 1], -1)
    agent = boards.agent.astype(np.int64)
    return LevelBatch(wall, target, cells, np.stack([agent // SIDE + 1, agent % SIDE + 1], -1))


def _unpack(boards: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return boards [M] as layers, [M, I, I]."""
    octets = np.ascontiguousarray(boards, "<u8").view(np.uint8).reshape(-1, SIDE)
    return np.unpackbits(octets, axis=1, bitorder="little").reshape(-1, SIDE, SIDE).astype(np.bool_)


def likeliest_boards(abstract_state: NDArray[np.float32]) -> BitBoards:
    """Return the likeliest boards of abstract states, [M, N, N, 4]; nothing stands in a wall or in the robot's cell."""
    certain = abstract_state > 0.5
    interior = abstract_state[:, 1:-1, 1:-1, AGENT].reshape(len(abstract_state), SQUARES)
    agent = interior.argmax(1)
    here = np.uint64(1) << agent.astype(np.uint64)
    wall = pack_boards(certain[..., WALL]) & ~here
    box = pack_boards(certain[..., BOX]) & ~wall & ~here
    return BitBoards(wall, pack_boards(certain[..., TARGET]) & ~wall, box, agent.astype(np.uint8))


def pack_boards(layers: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Return the interiors of layers bool [M, N, N] as 64-bit boards, [M]."""
    interior = np.ascontiguousarray(layers[:, 1:-1, 1:-1]).reshape(len(layers), SQUARES)
    return np.packbits(interior, axis=1, bitorder="little").view("<u8")[:, 0].astype(np.uint64)


def state_tensor(boards: BitBoards, symmetry: NDArray[np.int64] | None = None) -> Tensor:
    """Return abstract states, float32 [M, N, N, 4], each under its symmetry (int64 [M], see `symmetry`) if given."""
    n = len(boards.agent)
    state = np.zeros((n, GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32)
    _fill_states(*boards, np.zeros(n, np.int64) if symmetry is None else symmetry, cell_sources(SIDE), state)
    return torch.from_numpy(state)


def signed(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array as a type that tensors and their files have: boards as int64."""
    return array.view(np.int64) if array.dtype == np.uint64 else array


def _box_layer(levels: LevelBatch) -> NDArray[np.bool_]:
    layer = np.zeros(levels.wall.shape, np.bool_)
    level, index = np.nonzero(levels.boxes[..., 0] >= 0)
    cells = levels.boxes[level, index]
    layer[level, cells[:, 0], cells[:, 1]] = True
    return layer


@njit(cache=True, nogil=True)
def _fill_states(
    wall: NDArray[np.uint64],
    target: NDArray[np.uint64],
    box: NDArray[np.uint64],
    agent: NDArray[np.uint8],
    symmetry: NDArray[np.int64],
    sources: NDArray[np.int64],
    state: NDArray[np.float32],
) -> None:
    one = np.uint64(1)
    for i in range(len(agent)):
        state[i, :, :, WALL] = 1.0
        for c in range(SQUARES):
            source = np.uint64(sources[symmetry[i], c])
            row, column = c // SIDE + 1, c % SIDE + 1
            state[i, row, column, WALL] = np.float32((wall[i] >> source) & one)
            state[i, row, column, TARGET] = np.float32((target[i] >> source) & one)
            state[i, row, column, BOX] = np.float32((box[i] >> source) & one)
            if source == np.uint64(agent[i]):
                state[i, row, column, AGENT] = 1.0
