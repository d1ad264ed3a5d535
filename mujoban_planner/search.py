"""Levin tree search over pushes, guided by a planner network (Orseau et al. 2018), under the abstract rules.

A node is a state after a push; an edge is a legal push with the network's probability. Nodes are expanded in the order
of log(depth + 1) - sum of log-probabilities - weight * log p(alive): the policy says where to look, the dead-state head
what to leave. One network evaluation expands one node of every level that is still open.

Boards are those of `mujoban_sokoban.bitboard`. Shapes: M levels, I = 8, K pushes, T moves.
"""

from __future__ import annotations

import heapq
import math
from typing import Final, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch.nn import functional

from mujoban_core.grid import Instruction
from mujoban_planner.boards import BitBoards, state_tensor
from mujoban_planner.heads import verdicts
from mujoban_planner.planner import LearnedPlanner
from mujoban_sokoban.bitboard import NONE, ONE, SQUARE_STEP, SQUARES, Bits, bit, flood, lowest, shift
from mujoban_sokoban.solver_labels import moves_of, walk_distances

DEAD_WEIGHT: Final = 1.0
"""Weight of log p(alive) in a node's cost."""


class Node(NamedTuple):
    """A state in a tree."""

    cost: float
    order: int
    """Breaks ties, first come first served."""
    logp: float
    """Log-probability of the pushes that lead here."""
    moves: int
    """Moves of the way here."""
    box: int
    agent: int
    pushes: tuple[int, ...]
    """4 * square + direction of each push that leads here."""


class Found(NamedTuple):
    """Result of a search."""

    instructions: list[NDArray[np.int64]]
    """Instructions that solve each level; empty where none were found, M of [T]."""
    expansions: NDArray[np.int64]
    """Network evaluations of each level, [M]."""


def search(planner: LearnedPlanner, starts: BitBoards, *, expansions: int, limit: int) -> Found:
    """Search each level for a way to solve it.

    Args:
        planner: Guide.
        starts: States of M levels.
        expansions: Nodes expanded per level at most.
        limit: Moves of a solution at most, T.
    """
    trees = [_Tree(starts, i, limit) for i in range(len(starts.agent))]
    for _ in range(expansions):
        batch = [(tree, tree.pop()) for tree in trees if tree.open]
        if not batch:
            break
        rows = np.array([tree.row for tree, _ in batch])
        boards = BitBoards(
            starts.wall[rows],
            starts.target[rows],
            np.array([node.box for _, node in batch], np.uint64),
            np.array([node.agent for _, node in batch], np.uint8),
        )
        push, alive = _evaluate(planner, boards)
        for i, (tree, node) in enumerate(batch):
            tree.expand(node, push[i], alive[i])
    solutions = [tree.instructions() for tree in trees]
    return Found(solutions, np.array([tree.expanded for tree in trees], np.int64))


@torch.inference_mode()
def _evaluate(planner: LearnedPlanner, boards: BitBoards) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how promising pushes are, as log-probabilities, [M, 4, I * I], and log p(alive), [M]."""
    device = next(planner.parameters()).device
    output, _ = planner.read(state_tensor(boards).to(device))
    alive = functional.logsigmoid(-output.dead[:, Instruction.STAY])
    push = output.push + verdicts(output)
    return push.flatten(2).double().cpu().numpy(), alive.double().cpu().numpy()


class _Tree:
    """The search in one level."""

    def __init__(self, starts: BitBoards, row: int, limit: int) -> None:
        self.row = row
        self.expanded = 0
        self.solution: tuple[int, ...] | None = None
        self._wall, self._target = starts.wall[row], starts.target[row]
        self._start = (starts.box[row], int(starts.agent[row]))
        self._limit = limit
        self._heap = [Node(0.0, 0, 0.0, 0, int(starts.box[row]), int(starts.agent[row]), ())]
        self._seen: dict[tuple[int, int], int] = {}
        self._order = 0
        # Unequal numbers cannot be matched; an estimate may have them.
        if int(starts.box[row]).bit_count() != int(self._target).bit_count() or starts.box[row] & self._wall:
            self._heap = []
        elif starts.box[row] == self._target:
            self._heap, self.solution = [], ()

    @property
    def open(self) -> bool:
        return self.solution is None and bool(self._heap)

    def pop(self) -> Node:
        self.expanded += 1
        return heapq.heappop(self._heap)

    def expand(self, node: Node, push: NDArray[np.float64], alive: float) -> None:
        squares, directions, steps = _legal_pushes(self._wall, np.uint64(node.box), node.agent)
        logp = push[directions, squares]
        # The network's probabilities over what is legal.
        logp = node.logp + logp - np.logaddexp.reduce(logp) if len(logp) else logp
        for square, direction, walk, child_logp in zip(
            squares.tolist(), directions.tolist(), steps.tolist(), logp.tolist(), strict=True
        ):
            box = node.box ^ (1 << square) ^ (1 << (square + int(SQUARE_STEP[direction])))
            moves = node.moves + walk + 1
            pushes = (*node.pushes, 4 * square + direction)
            if moves > self._limit:
                continue
            if box == int(self._target):
                self.solution = pushes
                return
            key = (box, int(_region(self._wall, np.uint64(box), square)))
            if self._seen.get(key, 1 << 30) <= moves:
                continue
            self._seen[key] = moves
            self._order += 1
            cost = math.log(len(pushes) + 1) - child_logp - DEAD_WEIGHT * alive
            heapq.heappush(self._heap, Node(cost, self._order, child_logp, moves, box, square, pushes))

    def instructions(self) -> NDArray[np.int64]:
        if not self.solution:
            return np.zeros(0, np.int64)
        moves = np.zeros(self._limit + 1, np.int64)
        pushes = np.array(self.solution, np.uint8)
        moves_of(~self._wall, *self._start, pushes, np.random.default_rng(0), moves)
        return moves[: np.count_nonzero(moves)]


@njit(cache=True, nogil=True)
def _region(wall: Bits, box: Bits, agent: int) -> int:
    """Return the lowest square that the robot can walk to: states that differ only within it are alike."""
    return lowest(flood(bit(agent), ~wall & ~box))


@njit(cache=True, nogil=True)
def _legal_pushes(
    wall: Bits, box: Bits, agent: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the box square, the direction and the steps to walk before it of every push that is possible."""
    free = ~wall & ~box
    distance = np.empty(SQUARES, np.int8)
    walk_distances(agent, free, distance)
    reached = flood(bit(agent), free)
    squares, directions, steps = np.empty((3, SQUARES * 4), np.int64)
    n = 0
    for direction in range(4):
        pushable = shift(reached, direction) & box & shift(free, (direction + 2) % 4)
        while pushable != NONE:
            square = lowest(pushable)
            pushable &= pushable - ONE
            squares[n], directions[n] = square, direction
            steps[n] = distance[square - SQUARE_STEP[direction]]
            n += 1
    return squares[:n], directions[:n], steps[:n]
