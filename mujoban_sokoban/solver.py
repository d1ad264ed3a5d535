"""Solve Sokoban levels, optimally in player moves or faster and nearly so, and label states for imitation.

The search is in `mujoban_sokoban.solver_search`. Everything here releases the GIL while it works, and takes any number
of boxes on any closed grid of up to N x N cells.

Shapes: B levels, K boxes, N = `grid.GRID_SIZE`, S labelled states.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import GRID_SIZE, Instruction
from mujoban_sokoban import solver_search
from mujoban_sokoban.bitboard import squares_of, to_square
from mujoban_sokoban.levels import Level, LevelBatch, stack_levels, walls_around
from mujoban_sokoban.solver_labels import count_moves, label_batch, moves_of, search_batch
from mujoban_sokoban.solver_search import make_workspace

MAX_NODES: Final = 250_000
"""States that a search stores by default; enough for more than 99.9 % of levels of difficulty 5."""


class Status(IntEnum):
    """How a search ended."""

    BUDGET = solver_search.BUDGET
    """It ran out of nodes: the level may or may not be solvable."""
    SOLVED = solver_search.SOLVED
    UNSOLVABLE = solver_search.UNSOLVABLE
    """Proven: no sequence of moves solves the level."""


class Solution(NamedTuple):
    """Result of a search."""

    status: Status
    moves: NDArray[np.int64]
    """Values of `grid.Instruction`, walks included, [L]; empty unless solved."""
    pushes: int
    """Pushes among the moves."""
    nodes: int
    """States that the search stored."""


class Solutions(NamedTuple):
    """Results of a batch of searches."""

    status: NDArray[np.int64]
    """Values of `Status`, [B]."""
    length: NDArray[np.int64]
    """Moves of the solution, 0 unless solved, [B]."""
    pushes: NDArray[np.int64]
    """Pushes of the solution, [B]."""
    nodes: NDArray[np.int64]
    """[B]."""


class Demonstrations(NamedTuple):
    """States along solutions, with what to do in them. Cells are row * N + column."""

    status: NDArray[np.int64]
    """`Status` of each level, [B]; only solved ones have states."""
    level: NDArray[np.int64]
    """Index of the level that a state belongs to, ascending, [S]."""
    player: NDArray[np.uint8]
    """Cell, [S]."""
    boxes: NDArray[np.uint8]
    """Cells, in the order of the level's boxes, [S, K]; `solver_labels.ABSENT` where the level has fewer."""
    optimal: NDArray[np.bool_]
    """Which instructions are right: each that begins a shortest walk to the next push, or is that push, [S, 5]."""
    steps_to_go: NDArray[np.int16]
    """Moves to the solution, at least 1, [S]."""
    plan: NDArray[np.uint8]
    """Per cell, the instruction by which a box will next be pushed out of it, 0 for none, [S, N, N]."""


class Labels(NamedTuple):
    """What to do in each of B given states; zero where `status` is not `Status.SOLVED` or the state is solved."""

    status: NDArray[np.int64]
    """Values of `Status`, [B]."""
    optimal: NDArray[np.bool_]
    """As in `Demonstrations`, [B, 5]."""
    steps_to_go: NDArray[np.int16]
    """As in `Demonstrations`, [B]."""
    plan: NDArray[np.uint8]
    """As in `Demonstrations`, [B, N, N]."""


class _Solved(NamedTuple):
    solutions: Solutions
    pushes: NDArray[np.uint8]
    first_push: NDArray[np.int64]


def solve(
    wall: ArrayLike,
    target: ArrayLike,
    boxes: ArrayLike,
    player: ArrayLike,
    *,
    max_nodes: int = MAX_NODES,
    weight: float = 1.0,
) -> Solution:
    """Solve one level.

    Args:
        wall: bool [N, N], true all around the edge.
        target: bool [N, N].
        boxes: (row, column), [K, 2]; boxes at a negative row are absent.
        player: (row, column), [2].
        max_nodes: states to store before giving up.
        weight: 1 for the fewest moves; w > 1 for at most about w times as many, found much faster.

    Raises:
        ValueError: If shapes, positions, counts or options are out of range.
    """
    batch = _checked(LevelBatch(*(np.asarray(array)[None] for array in (wall, target, boxes, player))))
    solved = _solve(batch, max_nodes, weight)
    moves = np.empty(solved.solutions.length[0], np.int64)
    floor = np.uint64(0)
    for row, col in np.argwhere(~batch.wall[0]):
        floor |= np.uint64(1) << np.uint64(to_square(row, col))
    start = np.uint64(squares_of(batch.boxes[0]))
    moves_of(floor, start, to_square(*batch.player[0]), solved.pushes, np.random.default_rng(0), moves)
    return Solution(Status(int(solved.solutions.status[0])), moves, len(solved.pushes), int(solved.solutions.nodes[0]))


def solve_level(level: Level, *, max_nodes: int = MAX_NODES, weight: float = 1.0) -> Solution:
    """Solve one level; see `solve`."""
    return solve(level.wall, level.target, level.boxes, level.player, max_nodes=max_nodes, weight=weight)


def solve_levels(levels: Sequence[Level], *, max_nodes: int = MAX_NODES, weight: float = 1.0) -> Solutions:
    """Solve levels and return the figures of their solutions; options as in `solve`."""
    return solve_batch(stack_levels(levels), max_nodes=max_nodes, weight=weight)


def solve_batch(batch: LevelBatch, *, max_nodes: int = MAX_NODES, weight: float = 1.0) -> Solutions:
    """Solve a batch of levels, or of any states; options and errors as in `solve`."""
    return _solve(_checked(batch), max_nodes, weight).solutions


def demonstrations(
    batch: LevelBatch, *, rng: np.random.Generator, max_nodes: int = MAX_NODES, weight: float = 1.0
) -> Demonstrations:
    """Solve a batch of levels, or of any states, and label every state along the solutions.

    Args:
        batch: levels, as from `generator.generate_batch` or `levels.stack_levels`.
        rng: chooses among equally short walks; concurrent threads need one each.
        max_nodes: states to store in a search before giving up.
        weight: 1 for optimal demonstrations; more for nearly optimal ones at a higher rate.

    Raises:
        ValueError: As `solve`.
    """
    batch = _checked(batch)
    return _label(batch, _solve(batch, max_nodes, weight), rng, None)


def label_solutions(
    batch: LevelBatch, pushes: Sequence[NDArray[np.uint8]], *, rng: np.random.Generator
) -> Demonstrations:
    """Label every state along solutions that are known, however they were found.

    Args:
        batch: B levels.
        pushes: Pushes that solve each level, 4 * square + direction of the box, B of [its length], one at least.
        rng: Chooses among equally short walks.

    Raises:
        ValueError: As `solve`, or if a level has no pushes.
    """
    batch = _checked(batch)
    if len(pushes) != len(batch.wall) or not all(len(p) for p in pushes):
        raise ValueError(f"{len(pushes)} solutions of {len(batch.wall)} levels: expected one push at least for each")
    first = np.concatenate([[0], np.cumsum([len(p) for p in pushes])]).astype(np.int64)
    flat = np.concatenate([np.zeros(0, np.uint8), *pushes])
    length, nodes = np.zeros((2, len(pushes)), np.int64)
    count_moves(batch.wall, batch.boxes, batch.player, flat, first, length)
    status = np.full(len(pushes), Status.SOLVED, np.int64)
    return _label(batch, _Solved(Solutions(status, length, np.diff(first), nodes), flat, first), rng, None)


def label_states(batch: LevelBatch, *, max_nodes: int = MAX_NODES, weight: float = 1.0) -> Labels:
    """Label the given states alone, such as those that a policy visited (DAgger); options as in `demonstrations`.

    Raises:
        ValueError: As `solve`.
    """
    batch = _checked(batch)
    found = _label(batch, _solve(batch, max_nodes, weight), np.random.default_rng(0), 1)
    count = len(batch.wall)
    labels = Labels(
        found.status,
        np.zeros((count, len(Instruction)), np.bool_),
        np.zeros(count, np.int16),
        np.zeros((count, GRID_SIZE, GRID_SIZE), np.uint8),
    )
    labels.optimal[found.level] = found.optimal
    labels.steps_to_go[found.level] = found.steps_to_go
    labels.plan[found.level] = found.plan
    return labels


def _checked(batch: LevelBatch) -> LevelBatch:
    """Check a batch and return it as arrays of the kernels' types."""
    batch = LevelBatch(
        np.ascontiguousarray(batch.wall, np.bool_),
        np.ascontiguousarray(batch.target, np.bool_),
        np.ascontiguousarray(batch.boxes, np.int64),
        np.ascontiguousarray(batch.player, np.int64),
    )
    count = len(batch.wall)
    grid = (count, GRID_SIZE, GRID_SIZE)
    shapes = (batch.wall.shape, batch.target.shape, batch.boxes.shape[:1], batch.boxes.shape[2:], batch.player.shape)
    if shapes != (grid, grid, (count,), (2,), (count, 2)):
        raise ValueError(
            f"wall {batch.wall.shape}, target {batch.target.shape}, boxes {batch.boxes.shape} and player "
            f"{batch.player.shape}: expected [B, {GRID_SIZE}, {GRID_SIZE}] twice, [B, K, 2] and [B, 2]"
        )
    if not walls_around(batch.wall).all():
        raise ValueError("open boundary: expected walls all around the edge of the grid")
    present = batch.boxes[..., 0] >= 0
    cells = np.concatenate([batch.boxes[present], batch.player])
    owner = np.concatenate([np.nonzero(present)[0], np.arange(count)])
    outside = ((cells < 1) | (cells > GRID_SIZE - 2)).any(-1)
    if outside.any() or batch.wall[owner, cells[:, 0], cells[:, 1]].any():
        raise ValueError("box or player outside the grid or in a wall: expected floor cells")
    occupied = np.zeros(grid, np.int64)
    np.add.at(occupied, (owner, cells[:, 0], cells[:, 1]), 1)
    if (occupied > 1).any():
        raise ValueError("two things in one cell: expected boxes and player in cells of their own")
    if not present.any(1).all():
        raise ValueError("a level without boxes: expected at least one")
    if (batch.target & batch.wall).any() or (batch.target.sum((1, 2)) != present.sum(1)).any():
        raise ValueError("targets and boxes differ in number, or a target is in a wall: expected as many as boxes")
    return batch


def _solve(batch: LevelBatch, max_nodes: int, weight: float) -> _Solved:
    if max_nodes < 1:
        raise ValueError(f"max_nodes {max_nodes}: expected at least 1")
    if not 1.0 <= weight <= 10.0:
        raise ValueError(f"weight {weight}: expected 1 (optimal) to 10")
    count = len(batch.wall)
    status, length, nodes = np.zeros((3, count), np.int64)
    first = np.zeros(count + 1, np.int64)
    pushes = search_batch(*batch, float(weight), max_nodes, make_workspace(max_nodes), status, length, nodes, first)
    return _Solved(Solutions(status, length, np.diff(first), nodes), pushes, first)


def _label(batch: LevelBatch, solved: _Solved, rng: np.random.Generator, limit: int | None) -> Demonstrations:
    """Label at most `limit` states of each solution."""
    lengths = solved.solutions.length if limit is None else np.minimum(solved.solutions.length, limit)
    first_state = np.concatenate([[0], np.cumsum(lengths)])
    states, k_boxes = int(first_state[-1]), batch.boxes.shape[1]
    result = Demonstrations(
        solved.solutions.status,
        np.empty(states, np.int64),
        np.empty(states, np.uint8),
        np.empty((states, k_boxes), np.uint8),
        np.empty((states, len(Instruction)), np.bool_),
        np.empty(states, np.int16),
        np.empty((states, GRID_SIZE, GRID_SIZE), np.uint8),
    )
    label_batch(
        batch.wall,
        batch.boxes,
        batch.player,
        solved.solutions.status,
        solved.first_push,
        solved.pushes,
        first_state,
        rng,
        *result[1:],
        solved.solutions.length,
    )
    return result
