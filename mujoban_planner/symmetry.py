"""The eight symmetries of a square board, on cells and on instructions.

Symmetry s rotates by s % 4 quarter turns counter-clockwise and, for s >= 4, then mirrors east and west.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_sim.grid import OFFSETS_RC

SYMMETRIES = 8


def transform_board(board: NDArray[np.generic], symmetry: int) -> NDArray[np.generic]:
    """Return a board whose last two axes are rows and columns, transformed."""
    turned = np.rot90(board, symmetry % 4, axes=(-2, -1))
    return turned[..., ::-1] if symmetry >= 4 else turned


def transform_planes(states: Tensor, symmetry: int) -> Tensor:
    """Return abstract states [B, N, N, 4], transformed."""
    turned = torch.rot90(states, symmetry % 4, (1, 2))
    return turned.flip(2) if symmetry >= 4 else turned


def transform_pushes(pushes: Tensor, symmetry: int) -> Tensor:
    """Return values of the push of each cell's box in each direction, [B, D, I, I], transformed."""
    turned = torch.rot90(pushes, symmetry % 4, (2, 3))
    turned = turned.flip(3) if symmetry >= 4 else turned
    # Direction d of the transformed board was direction `source[d]` of the original one.
    source = np.argsort(instruction_map(symmetry))[1:] - 1
    return turned[:, source.tolist()]


@lru_cache
def instruction_map(symmetry: int) -> tuple[int, ...]:
    """Return, for each instruction on the original board, the instruction on the transformed one."""
    size = 3
    centre = np.zeros((size, size), np.int64)
    images = []
    for row, column in OFFSETS_RC:
        board = centre.copy()
        board[1 + row, 1 + column] = 1
        image = np.argwhere(transform_board(board, symmetry))[0] - 1
        images.append(int(np.flatnonzero((image == OFFSETS_RC).all(1))[0]))
    return tuple(images)


def instruction_permutation(symmetry: int, device: torch.device | str = "cpu") -> Tensor:
    """Return int64 [5] such that `values.gather(-1, permutation)` brings values back to the original board."""
    return torch.tensor(instruction_map(symmetry), device=device)


@lru_cache
def cell_sources(size: int) -> NDArray[np.int64]:
    """Return for each symmetry and cell of a transformed board the flat index it comes from, [8, size * size]."""
    board = np.arange(size * size).reshape(size, size)
    return np.stack([transform_board(board, s).reshape(-1) for s in range(SYMMETRIES)]).astype(np.int64)
