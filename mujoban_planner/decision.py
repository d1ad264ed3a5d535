"""What a planner remembers of an episode, so that it never repeats itself for ever.

A failed instruction leaves the state as it was, and a greedy policy would repeat it; a cycle of states likewise.
A push is therefore wanted less the more often it was tried with the boxes where they are, and less if it brings them
back to where they were, so that the robot walks to another one; and each instruction is less attractive the more often
it was tried in the same state. Estimates may flicker, so the robot's cell alone counts as well, more weakly.

Shapes: M episodes, H = `HISTORY` decisions, A = 5 instructions, D = 4 directions, N = `grid.GRID_SIZE`,
I = N - 2 = `heads.INTERIOR`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE, OFFSETS_RC, Instruction
from mujoban_planner.heads import INSTRUCTIONS, INTERIOR
from mujoban_planner.symmetry import SYMMETRIES

HISTORY = 256
"""Decisions remembered; an episode has at most 240 s, some 120 moves."""
PUSH_WEIGHT = 3.0
"""Log-probability lost per earlier try of the push with the boxes where they are."""
RETURN_WEIGHT = 6.0
"""Log-probability that a push loses which brings the boxes back to where they were before: a tabu, with exceptions."""
STATE_WEIGHT = 1.0
"""Log-probability lost per earlier try of the instruction in the same state. Small, because ways to several pushes
lead through the same states."""
ARRIVAL_WEIGHT = 1.5
"""Log-probability lost per try since the robot came to this cell."""
CELL_WEIGHT = 0.1
"""Log-probability lost per earlier try in the same cell beyond `CELL_PATIENCE`."""
CELL_PATIENCE = 6
STAY_WEIGHT = 3.0
"""Log-probability that STAY loses per earlier STAY in the same cell. Standing still changes nothing: a second time it
is worth no more than any move."""

_CELLS = GRID_SIZE * GRID_SIZE
_MIX = np.random.default_rng(0).integers(1, 2**62, size=(2, _CELLS), dtype=np.int64)
"""Zobrist keys of the agent's and the boxes' cells."""
_STEPS = OFFSETS_RC[1:] @ (GRID_SIZE, 1)
"""What each direction adds to a flat cell, [D]."""
_INTERIOR_CELL = np.asarray(
    np.ravel_multi_index(
        np.clip(np.indices((GRID_SIZE, GRID_SIZE)) - 1, 0, INTERIOR - 1).reshape(2, -1), (INTERIOR, INTERIOR)
    )
)
"""Flat cell of the interior of each flat cell, or the nearest to one of the border, [N * N]."""
_SLOTS = np.arange(HISTORY)
_STAY = int(Instruction.STAY)


class VisitMemory(NamedTuple):
    """The decisions of an episode so far; a ring of H."""

    boxes: NDArray[np.int64]
    """Hash of the boxes' arrangement at each decision, [M, H]; -1, which is no hash, where there is none yet."""
    cells: NDArray[np.int64]
    """Flat cell of the robot at each decision, [M, H]; -1 likewise."""
    moves: NDArray[np.int64]
    """Decisions, [M, H]."""
    count: NDArray[np.int64]
    """Number of decisions taken, [M]."""


class VisitCounts(NamedTuple):
    """How often each instruction was tried, [M, A] each, and each push."""

    state: NDArray[np.int64]
    """In the same state."""
    cell: NDArray[np.int64]
    """In the same cell."""
    since_arrival: NDArray[np.int64]
    """Since the robot came to this cell."""
    pushes: NDArray[np.float32]
    """Of the box in each cell in each direction, with all boxes where they are now, [M, D, N, N]."""
    returns: NDArray[np.bool_]
    """Whether such a push would bring the boxes back to where they were in an earlier decision, [M, D, N, N]."""


def initial_visits(batch: int) -> VisitMemory:
    """Return the memory of `batch` episodes without a decision."""
    shape = (batch, HISTORY)
    return VisitMemory(
        np.full(shape, -1, np.int64), np.full(shape, -1, np.int64), np.zeros(shape, np.int64), np.zeros(batch, np.int64)
    )


class PushMeans(NamedTuple):
    """Running means of the verdicts on pushes since the boxes stand as they do: test-time augmentation, view by view.

    Which push is best does not depend on where the robot is on its way to it, so that every decision of the walk can
    look at the board from another side.
    """

    boxes: NDArray[np.int64]
    """Hash of the boxes' arrangement, [M]."""
    views: NDArray[np.int64]
    """Number of views so far, [M]."""
    push: NDArray[np.float32]
    """Log-probability of each next push, [M, D, I, I]."""
    push_alive: NDArray[np.float32]
    """log(1 - p(dead)) of each push, [M, D, I, I]."""


def initial_means(batch: int) -> PushMeans:
    """Return the means of `batch` episodes before the first view."""
    shape = (batch, len(_STEPS), INTERIOR, INTERIOR)
    nothing = np.zeros(shape, np.float32)
    return PushMeans(np.zeros(batch, np.int64), np.zeros(batch, np.int64), nothing, nothing.copy())


def recall(abstract_state: NDArray[np.float32], means: PushMeans) -> PushMeans:
    """Return what still holds of `means` in these states, [M, N, N, 4]: nothing where the boxes have moved."""
    boxes = _box_keys(abstract_state)
    return means._replace(boxes=boxes, views=np.where(boxes == means.boxes, means.views, 0))


def running_mean(views: int, seen: Tensor, before: Tensor, now: Tensor) -> Tensor:
    """Return the mean of a plane, [M, D, I, I], over `seen` views, [M], before and so many further `views` now.

    Once every symmetric view was taken, the latest weigh more.
    """
    share = views / (seen.clamp(max=SYMMETRIES).to(now.dtype) + views)
    return before + share[:, None, None, None] * (now - before)


def doubtful(
    abstract_state: NDArray[np.float32], decision: NDArray[np.int64], means: PushMeans, doubt: float
) -> NDArray[np.bool_]:
    """Return which decisions, [M], are pushes that may be deadly and deserve more thought.

    A push cannot be taken back. Recurrent planners learn to pace before hard pushes for the same reason: it gives them
    time to think (Taufeeque et al. 2024).

    Args:
        abstract_state: [M, N, N, 4].
        decision: The decisions so far, [M].
        means: Of the pushes, these decisions included.
        doubt: Probability that a push is deadly from which on it deserves it.
    """
    rows = np.flatnonzero(decision != _STAY)
    direction, states = decision[rows] - 1, abstract_state[rows]
    ahead = (likeliest_cells(states) + _STEPS[direction]) % _CELLS
    p_alive = np.exp(means.push_alive.reshape(-1, len(_STEPS), INTERIOR**2)[rows, direction, _INTERIOR_CELL[ahead]])
    pushes = states.reshape(-1, _CELLS, len(CHANNELS))[np.arange(len(rows)), ahead, BOX] > 0.5
    deadly = np.zeros(len(decision), np.bool_)
    deadly[rows] = pushes & (p_alive < 1.0 - doubt)
    return deadly


def state_keys(abstract_state: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return a hash of (agent's likeliest cell, boxes likelier than not), [M]."""
    return _box_keys(abstract_state) ^ _MIX[0][likeliest_cells(abstract_state)]


def likeliest_cells(abstract_state: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the flat cell in which the robot is most likely, [M]."""
    return abstract_state[..., AGENT].reshape(-1, _CELLS).argmax(1).astype(np.int64)


def _box_keys(abstract_state: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return a hash of the cells in which a box is likelier than not, [M]; never negative."""
    return _hash_boxes(_likely_boxes(abstract_state))


def _hash_boxes(is_box: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.bitwise_xor.reduce(is_box * _MIX[1], axis=1)


def _likely_boxes(abstract_state: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return where a box is likelier than not, [M, N * N]."""
    return abstract_state[..., BOX].reshape(-1, _CELLS) > 0.5


def count_visits(abstract_state: NDArray[np.float32], visits: VisitMemory) -> VisitCounts:
    """Return how often each instruction was tried before in these states, [M, N, N, 4]."""
    is_box, cell = _likely_boxes(abstract_state), likeliest_cells(abstract_state)
    boxes = _hash_boxes(is_box)
    here, same = visits.cells == cell[:, None], visits.boxes == boxes[:, None]  # Shape [M, H]
    age = (visits.count[:, None] - 1 - _SLOTS) % HISTORY
    arrival = np.where(here, HISTORY, age).min(1)  # Age of the last decision elsewhere
    row, when = here.nonzero()
    tried = row * INSTRUCTIONS + visits.moves[row, when]

    def count(which: NDArray[np.bool_] | slice) -> NDArray[np.int64]:
        return np.bincount(tried[which], minlength=INSTRUCTIONS * len(cell)).reshape(-1, INSTRUCTIONS)

    return VisitCounts(
        count(same[row, when]),
        count(slice(None)),
        count(age[row, when] < arrival[row]),
        _tried_pushes(is_box, same, visits),
        _returning_pushes(is_box, boxes, visits),
    )


def _tried_pushes(is_box: NDArray[np.bool_], same: NDArray[np.bool_], visits: VisitMemory) -> NDArray[np.float32]:
    """Return `VisitCounts.pushes`: the moves towards a box, [M, N * N], of the decisions `same`, [M, H]."""
    counts = np.zeros((len(is_box), len(_STEPS), _CELLS), np.float32)
    row, when = (same & (visits.moves != _STAY)).nonzero()
    direction = visits.moves[row, when] - 1
    ahead = (visits.cells[row, when] + _STEPS[direction]) % _CELLS
    np.add.at(counts, (row, direction, ahead), is_box[row, ahead])
    return counts.reshape(-1, len(_STEPS), GRID_SIZE, GRID_SIZE)


def _returning_pushes(
    is_box: NDArray[np.bool_], boxes: NDArray[np.int64], visits: VisitMemory
) -> NDArray[np.bool_]:
    """Return `VisitCounts.returns`, given the hash of the boxes now, [M]."""
    row, cell = is_box.nonzero()
    after = (boxes[row] ^ _MIX[1][cell])[:, None] ^ _MIX[1][(cell[:, None] + _STEPS) % _CELLS]  # Shape [X, D]
    returns = np.zeros((len(is_box), len(_STEPS), _CELLS), np.bool_)
    returns[row, :, cell] = (after[:, :, None] == visits.boxes[row, None]).any(2)
    return returns.reshape(-1, len(_STEPS), GRID_SIZE, GRID_SIZE)


def push_penalty(counts: VisitCounts) -> NDArray[np.float32]:
    """Return what is taken off the log-probability of each push that is wanted, [M, D, N, N]."""
    return (PUSH_WEIGHT * counts.pushes + RETURN_WEIGHT * counts.returns).astype(np.float32)


def visit_penalty(counts: VisitCounts) -> NDArray[np.float64]:
    """Return what is taken off each instruction's log-probability, [M, A]."""
    penalty = STATE_WEIGHT * counts.state + ARRIVAL_WEIGHT * counts.since_arrival
    penalty = penalty + CELL_WEIGHT * np.maximum(counts.cell - CELL_PATIENCE, 0)
    penalty[:, _STAY] += STAY_WEIGHT * counts.cell[:, _STAY]
    return penalty


def remember(
    abstract_state: NDArray[np.float32], decision: NDArray[np.int64], visits: VisitMemory
) -> VisitMemory:
    """Return the memory after `decision`, [M], was taken in these states."""
    rows, slot = np.arange(len(decision)), visits.count % HISTORY
    boxes, cells, moves = visits.boxes.copy(), visits.cells.copy(), visits.moves.copy()
    boxes[rows, slot], cells[rows, slot] = _box_keys(abstract_state), likeliest_cells(abstract_state)
    moves[rows, slot] = decision
    return VisitMemory(boxes, cells, moves, visits.count + 1)
