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


def view_states(states: Tensor, views: int) -> Tensor:
    """Return abstract states [B, N, N, 4] under symmetries 0 to `views` - 1, [views * B, N, N, 4]."""
    size = states.shape[1]
    seen = states.flatten(1, 2)[:, _view_sources(size, views).to(states.device)]  # Shape [B, views, N * N, 4]
    return seen.transpose(0, 1).reshape(-1, size, size, states.shape[3])


def average_instructions(values: Tensor, views: int) -> Tensor:
    """Return the mean over views, [B, A], of values of instructions in `view_states`, [views * B, A]."""
    values = values.unflatten(0, (views, -1))
    return values.take_along_dim(_instruction_images(views).to(values.device), 2).mean(0)


def average_pushes(values: Tensor, views: int) -> Tensor:
    """Return the mean over views, [B, D, I, I], of values of the push of each cell's box in each direction."""
    directions, size = values.shape[1:3]
    flat = values.reshape(views, -1, directions * size * size)
    return flat.take_along_dim(_push_images(size, views).to(values.device), 2).mean(0).view(-1, directions, size, size)


@lru_cache
def _view_sources(size: int, views: int) -> Tensor:
    """Return the flat cell from which each cell of each view comes, int64 [views, size * size]."""
    return torch.from_numpy(cell_sources(size)[:views])


@lru_cache
def _instruction_images(views: int) -> Tensor:
    """Return what each instruction is in each view, int64 [views, 1, A]."""
    return torch.tensor([[instruction_map(s)] for s in range(views)])


@lru_cache
def _push_images(size: int, views: int) -> Tensor:
    """Return where the push of each cell's box in each direction stands in each view, int64 [views, 1, D * size**2]."""
    images = np.argsort(cell_sources(size)[:views], axis=1)  # Shape [views, size * size]
    directions = np.array([instruction_map(s)[1:] for s in range(views)]) - 1  # Shape [views, D]
    flat = directions[:, :, None] * size * size + images[:, None]
    return torch.from_numpy(flat.reshape(views, 1, -1))


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
