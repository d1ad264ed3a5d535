"""What a planner remembers of an episode, so that it never repeats itself for ever.

A failed instruction leaves the state as it was, and a greedy policy would repeat it; a cycle of states likewise.
Each instruction is therefore made less attractive the more often it was tried in the same state. Estimates may
flicker, so the robot's cell alone counts as well, more weakly.

Shapes: M episodes, H = `HISTORY` decisions, A = 5 instructions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_sim.grid import AGENT, BOX, GRID_SIZE, OFFSETS_RC, Instruction

HISTORY = 256
"""Decisions remembered; an episode has at most 240 s, some 120 moves."""
STATE_WEIGHT = 3.0
"""Log-probability lost per earlier try of the instruction in the same state."""
ARRIVAL_WEIGHT = 1.5
"""Log-probability lost per try since the robot came to this cell."""
CELL_WEIGHT = 0.3
"""Log-probability lost per earlier try in the same cell beyond `CELL_PATIENCE`."""
CELL_PATIENCE = 6

_MIX = np.random.default_rng(0).integers(1, 2**62, size=(2, GRID_SIZE * GRID_SIZE), dtype=np.int64)
"""Zobrist keys of the agent's and the boxes' cells."""


class VisitMemory(NamedTuple):
    """The decisions of an episode so far; a ring of H."""

    keys: NDArray[np.int64]
    """Hash of the state in which each decision was taken, [M, H]."""
    cells: NDArray[np.int64]
    """Flat cell of the robot at each decision, [M, H]; -1 where there is none yet."""
    moves: NDArray[np.int64]
    """Decisions, [M, H]."""
    count: NDArray[np.int64]
    """Number of decisions taken, [M]."""


class VisitCounts(NamedTuple):
    """How often each instruction was tried, [M, A] each."""

    state: NDArray[np.int64]
    """In the same state."""
    cell: NDArray[np.int64]
    """In the same cell."""
    since_arrival: NDArray[np.int64]
    """Since the robot came to this cell."""


def initial_visits(batch: int) -> VisitMemory:
    """Return the memory of `batch` episodes without a decision."""
    shape = (batch, HISTORY)
    return VisitMemory(
        np.zeros(shape, np.int64), np.full(shape, -1, np.int64), np.zeros(shape, np.int64), np.zeros(batch, np.int64)
    )


def state_keys(abstract_state: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return a hash of (agent's likeliest cell, boxes likelier than not), [M], and that cell, [M]."""
    flat = abstract_state.reshape(len(abstract_state), GRID_SIZE * GRID_SIZE, -1)
    cell = flat[:, :, AGENT].argmax(1)
    boxes = np.bitwise_xor.reduce(np.where(flat[:, :, BOX] > 0.5, _MIX[1], 0), axis=1)
    return boxes ^ _MIX[0][cell], cell.astype(np.int64)


def count_visits(abstract_state: NDArray[np.float32], visits: VisitMemory) -> VisitCounts:
    """Return how often each instruction was tried before in these states, [M, N, N, 4]."""
    key, cell = state_keys(abstract_state)
    instructions = np.arange(len(OFFSETS_RC))
    chosen = visits.moves[:, :, None] == instructions  # Shape [M, H, A]
    here = (visits.cells == cell[:, None])[:, :, None] & chosen
    same = (visits.keys == key[:, None])[:, :, None] & here
    # Walk back from the last decision while the robot was in this cell.
    back = (visits.count[:, None] - 1 - np.arange(HISTORY)) % HISTORY  # Shape [M, H]
    recent = np.take_along_axis(here, back[:, :, None], axis=1)
    staying = np.cumprod(recent.any(2), axis=1).astype(np.bool_)
    return VisitCounts(same.sum(1), here.sum(1), (recent & staying[:, :, None]).sum(1))


def visit_penalty(counts: VisitCounts) -> NDArray[np.float64]:
    """Return what is taken off each instruction's log-probability, [M, A]."""
    penalty = STATE_WEIGHT * counts.state + ARRIVAL_WEIGHT * counts.since_arrival
    penalty = penalty + CELL_WEIGHT * np.maximum(counts.cell - CELL_PATIENCE, 0)
    # Standing still changes nothing: a second time it is worth no more than any move.
    penalty[:, Instruction.STAY] += STATE_WEIGHT * counts.cell[:, Instruction.STAY]
    return penalty


def remember(
    abstract_state: NDArray[np.float32], decision: NDArray[np.int64], visits: VisitMemory
) -> VisitMemory:
    """Return the memory after `decision`, [M], was taken in these states."""
    key, cell = state_keys(abstract_state)
    rows, slot = np.arange(len(decision)), visits.count % HISTORY
    keys, cells, moves = visits.keys.copy(), visits.cells.copy(), visits.moves.copy()
    keys[rows, slot], cells[rows, slot], moves[rows, slot] = key, cell, decision
    return VisitMemory(keys, cells, moves, visits.count + 1)
