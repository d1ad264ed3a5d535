"""The eight symmetries of a square board, on cells and on instructions.

Symmetry s rotates by s % 4 quarter turns counter-clockwise and, for s >= 4, then mirrors east and west.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import OFFSETS_RC

SYMMETRIES = 8


def transform_board(board: NDArray[np.generic], symmetry: int) -> NDArray[np.generic]:
    """Return a board whose last two axes are rows and columns, transformed."""
    turned = np.rot90(board, symmetry % 4, axes=(-2, -1))
    return turned[..., ::-1] if symmetry >= 4 else turned


def view_states(states: Tensor, symmetries: Tensor) -> Tensor:
    """Return abstract states [B, N, N, 4] under `symmetries`, int64 [B, V]: [B * V, N, N, 4], state by state."""
    size, channels = states.shape[2:]
    sources = _view_sources(size).to(states.device)[symmetries].flatten(1)[:, :, None]  # Shape [B, V * N * N, 1]
    return states.flatten(1, 2).take_along_dim(sources, 1).view(-1, size, size, channels)


def average_instructions(values: Tensor, symmetries: Tensor) -> Tensor:
    """Return the mean over views, [B, A], of values of instructions in `view_states`, [B * V, A]."""
    images = _instruction_images().to(values.device)[symmetries]
    return values.view(*symmetries.shape, -1).take_along_dim(images, 2).mean(1)


def average_pushes(values: Tensor, symmetries: Tensor) -> Tensor:
    """Return the mean over views, [B, D, I, I], of values of the push of each cell's box in each direction."""
    directions, size = values.shape[1:3]
    images = push_images(size).to(values.device)[symmetries]
    flat = values.reshape(*symmetries.shape, -1)
    return flat.take_along_dim(images, 2).mean(1).view(-1, directions, size, size)


@lru_cache
def _view_sources(size: int) -> Tensor:
    """Return the flat cell from which each cell of each view comes, int64 [8, size * size]."""
    return torch.from_numpy(cell_sources(size))


@lru_cache
def _instruction_images() -> Tensor:
    """Return what each instruction is in each view, int64 [8, A]."""
    return torch.tensor([instruction_map(s) for s in range(SYMMETRIES)])


@lru_cache
def push_images(size: int) -> Tensor:
    """Return where the push of each cell's box in each direction stands in each view, int64 [8, D * size**2]."""
    images = np.argsort(cell_sources(size), axis=1)  # Shape [8, size * size]
    directions = np.array([instruction_map(s)[1:] for s in range(SYMMETRIES)]) - 1  # Shape [8, D]
    flat = directions[:, :, None] * size * size + images[:, None]
    return torch.from_numpy(flat.reshape(SYMMETRIES, -1))


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


@lru_cache
def cell_sources(size: int) -> NDArray[np.int64]:
    """Return for each symmetry and cell of a transformed board the flat index it comes from, [8, size * size]."""
    board = np.arange(size * size).reshape(size, size)
    return np.stack([transform_board(board, s).reshape(-1) for s in range(SYMMETRIES)]).astype(np.int64)
