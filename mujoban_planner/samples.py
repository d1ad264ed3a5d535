"""Labelled states for imitation: compact storage, a ring buffer, and batches under random symmetries.

Sets of instructions are bit masks of `grid.Instruction`.

Shapes: S samples, B batch, I = 8 rows and columns of the interior, A = 5 instructions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import Instruction
from mujoban_planner.boards import BitBoards, signed, state_tensor
from mujoban_planner.symmetry import SYMMETRIES, cell_sources, instruction_map
from mujoban_rl.engine import State
from mujoban_sokoban.bitboard import SIDE, SQUARES

EVERY_INSTRUCTION = (1 << len(Instruction)) - 1
"""The mask of all instructions."""
_MOVES = len(Instruction) - 1


class Samples(NamedTuple):
    """Labelled states, one per row."""

    wall: NDArray[np.uint64]
    """Board as in `boards.BitBoards`, and so the next three, [S]."""
    target: NDArray[np.uint64]
    box: NDArray[np.uint64]
    agent: NDArray[np.uint8]
    right: NDArray[np.uint8]
    """Mask of the instructions that start a shortest way along the demonstration; 0 if unknown or dead, [S]."""
    plan: NDArray[np.uint8]
    """Instruction by which a box will next be pushed out of each square, [S, I * I]."""
    value: NDArray[np.float32]
    """Discounted return of the demonstration from here, [S]."""
    dead_known: NDArray[np.uint8]
    """Mask of the instructions whose outcome is known to be solvable or not, [S]."""
    dead: NDArray[np.uint8]
    """Mask of the instructions after which no solution is left, [S]."""
    next_push: NDArray[np.uint8]
    """Next push, 4 * square of the box + direction, [S]; any value where `right` is 0."""
    push_known: NDArray[np.uint64]
    """Boxes whose push in each direction is known to leave a solution or none, as boards, [S, 4]."""
    push_dead: NDArray[np.uint64]
    """Boxes whose push in each direction leaves no solution, as boards, [S, 4]."""

    @property
    def boards(self) -> BitBoards:
        """The states."""
        return BitBoards(self.wall, self.target, self.box, self.agent)

    def take(self, rows: NDArray[Any]) -> Samples:
        """Return the given rows, by index or mask."""
        return Samples._make(column[rows] for column in self)


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
    push_known: Tensor
    """bool [B, 4, I, I]."""
    push_dead: Tensor
    """bool [B, 4, I, I]."""
    chosen: Tensor
    """Whether what is known of pushes hangs on what it is: a solution is found sooner than a proof; bool [B]."""

    def to(self, device: torch.device | str) -> Batch:
        """Return the batch on a device."""
        return Batch._make(x.to(device, non_blocking=True) for x in self)


def unlabelled(boards: BitBoards) -> Samples:
    """Return samples of states that say nothing yet."""
    n = len(boards.agent)
    masks = [np.zeros(n, np.uint8) for _ in range(4)]
    plan, value = np.zeros((n, SQUARES), np.uint8), np.zeros(n, np.float32)
    known, dead = np.zeros((2, n, _MOVES), np.uint64)
    return Samples(*boards, masks[0], plan, value, *masks[1:], push_known=known, push_dead=dead)


def concatenate(parts: list[Samples]) -> Samples:
    """Return the rows of all parts."""
    return Samples._make(np.concatenate(columns) for columns in zip(*parts, strict=True))


class SampleBuffer:
    """A ring of samples, filled as demonstrations arrive."""

    def __init__(self, capacity: int) -> None:
        """Allocate room for `capacity` samples; the oldest are overwritten."""
        self.capacity = capacity
        self.size = 0
        self.added = 0
        none = np.zeros(capacity, np.uint64)
        self.storage = unlabelled(BitBoards(none, none.copy(), none.copy(), np.zeros(capacity, np.uint8)))

    def add(self, samples: Samples) -> None:
        """Append samples.

        Raises:
            ValueError: If there are more than the capacity.
        """
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
        return self.storage.take(rng.integers(0, self.size, n))

    def state(self) -> State:
        """Return what the buffer holds."""
        columns = self.storage._asdict().items()
        return State({"added": self.added}, {k: torch.from_numpy(signed(v[: self.size])) for k, v in columns})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.added = state.values["added"]
        self.size = min(self.added, self.capacity)
        for name, column in self.storage._asdict().items():
            signed(column)[: self.size] = state.tensors[name].numpy()


def make_batch(samples: Samples, symmetry: NDArray[np.int64]) -> Batch:
    """Return the tensors of samples, each under its own symmetry, int64 [S] in 0..7."""
    n = len(samples.agent)
    plan = np.empty((n, SQUARES), np.int64)
    masks = np.empty((3, n, len(Instruction)), np.bool_)
    stacked = np.stack([samples.right, samples.dead_known, samples.dead])
    _fill_labels(samples.plan, stacked, symmetry, _SOURCES, _INSTRUCTION_MAPS, plan, masks)
    right, dead_known, dead = torch.from_numpy(masks).unbind()
    return Batch(
        state_tensor(samples.boards, symmetry),
        right,
        torch.from_numpy(plan).view(n, SIDE, SIDE),
        torch.from_numpy(samples.value.copy()),
        dead_known,
        dead,
        torch.from_numpy(_next_pushes(samples.next_push, symmetry)),
        _push_planes(samples.push_known, symmetry),
        _push_planes(samples.push_dead, symmetry),
        torch.zeros(n, dtype=torch.bool),
    )


_SOURCES = cell_sources(SIDE)
_DESTINATIONS = np.argsort(_SOURCES, axis=1)
"""Where each square goes under each symmetry, [8, I * I]."""
_INSTRUCTION_MAPS = np.array([instruction_map(s) for s in range(SYMMETRIES)], np.int64)


def _next_pushes(next_push: NDArray[np.uint8], symmetry: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the flat index into [4, I, I] of pushes seen under symmetries, [S]."""
    square, direction = next_push.astype(np.int64) // 4, next_push.astype(np.int64) % 4
    direction = _INSTRUCTION_MAPS[symmetry, direction + 1] - 1
    return direction * SQUARES + _DESTINATIONS[symmetry, square]


def _push_planes(pushes: NDArray[np.uint64], symmetry: NDArray[np.int64]) -> Tensor:
    """Return sets of pushes, boards [S, 4], under symmetries as bool [S, 4, I, I]."""
    planes = np.empty((len(pushes), _MOVES, SQUARES), np.bool_)
    _fill_pushes(pushes, symmetry, _SOURCES, _INSTRUCTION_MAPS, planes)
    return torch.from_numpy(planes).view(-1, _MOVES, SIDE, SIDE)


@njit(cache=True, nogil=True)
def _fill_pushes(
    pushes: NDArray[np.uint64],
    symmetry: NDArray[np.int64],
    sources: NDArray[np.int64],
    maps: NDArray[np.int64],
    out: NDArray[np.bool_],
) -> None:
    for i in range(len(pushes)):
        s = symmetry[i]
        for d in range(pushes.shape[1]):
            board, image = pushes[i, d], maps[s, d + 1] - 1
            for c in range(SQUARES):
                out[i, image, c] = (board >> np.uint64(sources[s, c])) & np.uint64(1)


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
        for c in range(SQUARES):
            out_plan[i, c] = maps[s, plan[i, sources[s, c]]]
        for m in range(masks.shape[0]):
            for a in range(maps.shape[1]):
                out_masks[m, i, maps[s, a]] = (masks[m, i] >> a) & 1
