"""Labelled states for imitation: compact storage, a ring buffer, and batches under random symmetries.

The interior of a level has 8 x 8 cells, so each layer of a state is one 64-bit board; bit i is the cell of flat
interior index i. Sets of instructions are bit masks of `grid.Instruction`.

Shapes: S samples, B batch, I = 8, A = 5 instructions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from mujoban_planner.planner import INSTRUCTIONS, INTERIOR
from mujoban_planner.symmetry import SYMMETRIES, cell_sources, instruction_map
from mujoban_sim.grid import AGENT, BOX, CHANNELS, GRID_SIZE, TARGET, WALL

CELLS = INTERIOR * INTERIOR


class Samples(NamedTuple):
    """Labelled states, one per row."""

    wall: NDArray[np.uint64]
    """[S]."""
    target: NDArray[np.uint64]
    """[S]."""
    box: NDArray[np.uint64]
    """[S]."""
    agent: NDArray[np.uint8]
    """Interior index of the robot's cell, [S]."""
    right: NDArray[np.uint8]
    """Mask of the instructions that start a shortest way along the demonstration; 0 if unknown or dead, [S]."""
    plan: NDArray[np.uint8]
    """Instruction by which a box will next be pushed out of each cell, [S, I * I]."""
    value: NDArray[np.float32]
    """Discounted return of the demonstration from here, [S]."""
    dead_known: NDArray[np.uint8]
    """Mask of the instructions whose outcome is known to be solvable or not, [S]."""
    dead: NDArray[np.uint8]
    """Mask of the instructions after which no solution is left, [S]."""
    push: NDArray[np.bool_]
    """Whether a right instruction pushes a box, [S]."""
    next_push: NDArray[np.uint8]
    """Next push, 4 * interior index of the box + direction, [S]; any value where `right` is 0."""


class Batch(NamedTuple):
    """Tensors of one training step."""

    state: Tensor
    """Abstract states, float32 [B, N, N, 4]."""
    right: Tensor
    """bool [B, A]."""
    plan: Tensor
    """int64 [B, I, I]."""
    value: Tensor
    """float32 [B]."""
    dead_known: Tensor
    """bool [B, A]."""
    dead: Tensor
    """bool [B, A]."""
    next_push: Tensor
    """Flat index into [4, I, I], int64 [B]."""

    def to(self, device: torch.device | str) -> Batch:
        """Return the batch on a device."""
        return Batch(*(x.to(device, non_blocking=True) for x in self))


def empty_samples(capacity: int) -> Samples:
    """Return storage for `capacity` samples."""
    boards = [np.zeros(capacity, np.uint64) for _ in range(3)]
    masks = [np.zeros(capacity, np.uint8) for _ in range(2)]
    plan = np.zeros((capacity, CELLS), np.uint8)
    return Samples(
        *boards,
        *masks,
        plan,
        np.zeros(capacity, np.float32),
        np.zeros(capacity, np.uint8),
        np.zeros(capacity, np.uint8),
        np.zeros(capacity, np.bool_),
        np.zeros(capacity, np.uint8),
    )


def concatenate(parts: list[Samples]) -> Samples:
    """Return the rows of all parts."""
    return Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def take(samples: Samples, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Samples:
    """Return the given rows."""
    return Samples(*(column[rows] for column in samples))


class SampleBuffer:
    """A ring of samples, filled as demonstrations arrive."""

    def __init__(self, capacity: int) -> None:
        """Allocate room for `capacity` samples; the oldest are overwritten."""
        self.capacity = capacity
        self.size = 0
        self.added = 0
        self.storage = empty_samples(capacity)

    def add(self, samples: Samples) -> None:
        """Append samples."""
        n = len(samples.agent)
        if n > self.capacity:
            raise ValueError(f"{n} samples for a buffer of {self.capacity}: expected no more than fit")
        slots = (self.added + np.arange(n)) % self.capacity
        for column, values in zip(self.storage, samples, strict=True):
            column[slots] = values
        self.added += n
        self.size = min(self.added, self.capacity)

    def draw(self, n: int, rng: np.random.Generator) -> Samples:
        """Return `n` random samples, with replacement."""
        return take(self.storage, rng.integers(0, self.size, n))


def make_batch(samples: Samples, symmetry: NDArray[np.int64]) -> Batch:
    """Return the tensors of samples, each under its own symmetry, int64 [S] in 0..7."""
    n = len(samples.agent)
    plan = np.empty((n, CELLS), np.int64)
    masks = np.empty((3, n, INSTRUCTIONS), np.bool_)
    _fill_labels(
        samples.plan,
        np.stack([samples.right, samples.dead_known, samples.dead]),
        symmetry,
        _SOURCES,
        _INSTRUCTION_MAPS,
        plan,
        masks,
    )
    return Batch(
        state_tensor(samples.wall, samples.target, samples.box, samples.agent, symmetry),
        torch.from_numpy(masks[0]),
        torch.from_numpy(plan).view(n, INTERIOR, INTERIOR),
        torch.from_numpy(samples.value.copy()),
        torch.from_numpy(masks[1]),
        torch.from_numpy(masks[2]),
        torch.from_numpy(_next_pushes(samples.next_push, symmetry)),
    )


_SOURCES = cell_sources(INTERIOR)
_INSTRUCTION_MAPS = np.array([instruction_map(s) for s in range(SYMMETRIES)], np.int64)


def state_tensor(
    wall: NDArray[np.uint64],
    target: NDArray[np.uint64],
    box: NDArray[np.uint64],
    agent: NDArray[np.uint8],
    symmetry: NDArray[np.int64] | None = None,
) -> Tensor:
    """Return abstract states, float32 [S, N, N, 4], of boards [S], each under its symmetry if given."""
    n = len(agent)
    state = np.zeros((n, GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32)
    symmetry = np.zeros(n, np.int64) if symmetry is None else symmetry
    _fill_states(wall, target, box, agent, symmetry, _SOURCES, state)
    return torch.from_numpy(state)


def _next_pushes(next_push: NDArray[np.uint8], symmetry: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the flat index into [4, I, I] of pushes seen under symmetries, [S]."""
    square, direction = next_push.astype(np.int64) // 4, next_push.astype(np.int64) % 4
    direction = _INSTRUCTION_MAPS[symmetry, direction + 1] - 1
    return direction * CELLS + _DESTINATIONS[symmetry, square]


_DESTINATIONS = np.argsort(_SOURCES, axis=1)
"""Where each interior cell goes under each symmetry, [8, I * I]."""


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
        for c in range(CELLS):
            source = np.uint64(sources[symmetry[i], c])
            row, column = c // INTERIOR + 1, c % INTERIOR + 1
            state[i, row, column, WALL] = np.float32((wall[i] >> source) & one)
            state[i, row, column, TARGET] = np.float32((target[i] >> source) & one)
            state[i, row, column, BOX] = np.float32((box[i] >> source) & one)
            if source == np.uint64(agent[i]):
                state[i, row, column, AGENT] = 1.0


@njit(cache=True, nogil=True)
def _fill_labels(
    plan: NDArray[np.uint8],
    masks: NDArray[np.uint8],
    symmetry: NDArray[np.int64],
    sources: NDArray[np.int64],
    maps: NDArray[np.int64],
    out_plan: NDArray[np.int64],
    out_masks: NDArray[np.bool_],
) -> None:
    for i in range(plan.shape[0]):
        s = symmetry[i]
        for c in range(CELLS):
            out_plan[i, c] = maps[s, plan[i, sources[s, c]]]
        for m in range(masks.shape[0]):
            for a in range(INSTRUCTIONS):
                out_masks[m, i, maps[s, a]] = (masks[m, i] >> a) & 1


def pack_boards(boards: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Return 64-bit boards, [S], of the interiors of boards bool [S, N, N]."""
    interior = np.ascontiguousarray(boards[:, 1:-1, 1:-1]).reshape(len(boards), CELLS)
    return np.packbits(interior, axis=1, bitorder="little").view("<u8")[:, 0].astype(np.uint64)


def unpack_boards(boards: NDArray[np.uint64], outside: bool) -> NDArray[np.bool_]:
    """Return boards bool [S, N, N] whose border holds `outside`, the inverse of `pack_boards`."""
    bits = np.unpackbits(np.ascontiguousarray(boards, "<u8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little")
    full = np.full((len(boards), GRID_SIZE, GRID_SIZE), outside)
    full[:, 1:-1, 1:-1] = bits.reshape(-1, INTERIOR, INTERIOR).astype(np.bool_)
    return full
