"""Many searches through pushes at once: trees, their queues and their verdicts on 64-bit boards.

A tree's node is a state after a push; states that differ only in where the robot stands within the region that it can
walk to are one. A node's cost says when it is expanded (`Forest.expand`). Pushes after which a box stands on a square
from which no target can be reached, or is frozen off the targets, lead nowhere and make no node.

What a search leaves behind proves more than a solution: a state all of whose ways on were followed to their ends is
dead, and so is whatever leads only to such states (`Forest.judge`). No solver is needed for that.

Shapes: M trees, N nodes of a tree, R rows, D = 4 directions, I = 8.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_planner.boards import BitBoards, signed
from mujoban_planner.forest_kernels import Trees, expand, judge, plant, pop, question, wander
from mujoban_rl.engine import State

_BRANCHING: Final = 12
"""Nodes kept for each expansion; what does not fit is left out."""


class Verdicts(NamedTuple):
    """What a search proved about the pushes of the nodes that it expanded; X of them."""

    node: NDArray[np.int64]
    """[X]."""
    solvable: NDArray[np.bool_]
    """Whether a solution from here was found, [X]."""
    lost: NDArray[np.bool_]
    """Whether none is left, [X]."""
    known: NDArray[np.uint64]
    """Boxes whose push in each direction is known to leave a solution or none, as boards, [X, D]."""
    dead: NDArray[np.uint64]
    """Boxes whose push in each direction leaves none, as boards, [X, D]."""
    searched: NDArray[np.bool_]
    """Whether it took a search to know that some push is dead, [X]."""


class Forest:
    """Searches in M levels, all of which take a step at a time."""

    def __init__(self, trees: int, expansions: int, limit: int) -> None:
        """Make room for `trees` searches of at most `expansions` nodes and solutions of at most `limit` moves."""
        n = _BRANCHING * expansions + 2
        shape = (trees, n)
        self.limit = limit
        self.trees = Trees(
            wall=np.zeros(trees, np.uint64),
            target=np.zeros(trees, np.uint64),
            dead=np.zeros(trees, np.uint64),
            box=np.zeros(shape, np.uint64),
            agent=np.zeros(shape, np.uint8),
            region=np.zeros(shape, np.uint8),
            cost=np.zeros(shape, np.float32),
            logp=np.zeros(shape, np.float32),
            moves=np.zeros(shape, np.int16),
            depth=np.zeros(shape, np.int16),
            parent=np.zeros(shape, np.int32),
            push=np.zeros(shape, np.uint8),
            expanded=np.zeros(shape, np.bool_),
            heap=np.zeros(shape, np.int32),
            table=np.full((trees, 1 << (2 * n - 1).bit_length()), -1, np.int32),
            nodes=np.zeros(trees, np.int64),
            waiting=np.zeros(trees, np.int64),
            solution=np.full(trees, -1, np.int64),
            expansions=np.zeros(trees, np.int64),
            settled=np.zeros(shape, np.bool_),
            branch=np.zeros(shape, np.int32),
        )

    @property
    def open(self) -> NDArray[np.bool_]:
        """Whether a search has found nothing yet but has somewhere to look, [M]."""
        return (self.trees.solution < 0) & (self.trees.waiting > 0)

    @property
    def expansions(self) -> NDArray[np.int64]:
        """Nodes that each search expanded, [M]."""
        return self.trees.expansions

    def plant(self, rows: NDArray[np.int64], boards: BitBoards) -> None:
        """Start searches from R states in the trees `rows`, [R].

        A state that is solved is over at once, and so is one that cannot be: an estimate may have fewer targets than
        boxes, or a box in a wall.
        """
        plant(self.trees, rows, *boards)

    def pop(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], BitBoards]:
        """Take the cheapest node out of each of R trees that are open; return nodes, [R], and states."""
        nodes = np.empty(len(rows), np.int64)
        pop(self.trees, rows, nodes)
        return nodes, self.boards(rows, nodes)

    def expand(
        self,
        rows: NDArray[np.int64],
        nodes: NDArray[np.int64],
        push: NDArray[np.float32],
        alive: NDArray[np.float32],
    ) -> None:
        """Put what R nodes lead to into their trees.

        Args:
            rows: Trees, [R].
            nodes: Nodes that `pop` returned, [R].
            push: How promising each push is, a log-probability up to a constant, [R, D, I * I].
            alive: log p(alive) of the nodes' states, [R].
        """
        expand(self.trees, rows, nodes, push, alive, self.limit)

    def wander(self, rows: NDArray[np.int64], chance: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return a node that one push leads to from the first of R trees, by chance as its probabilities are, [R].

        Args:
            rows: Trees whose first node alone was expanded, [R].
            chance: Uniform random numbers from [0, 1), [R].

        Returns:
            -1 where no push leads anywhere.
        """
        children = np.empty(len(rows), np.int64)
        wander(self.trees, rows, chance, children)
        return children

    def question(self, rows: NDArray[np.int64]) -> None:
        """Let R trees that are solved, [R], search on: does each push beside the way leave a solution too?

        The search starts anew from every state on the way, that is, a push costs what it costs from there. A push is
        judged when the search from it comes to the solution or to what is known to lead there, or to its end. While
        nodes wait in the tree, `pop` and `expand` go on.
        """
        question(self.trees, rows)

    def solution(self, row: int) -> NDArray[np.uint8]:
        """Return the pushes of a solution, 4 * square + direction, [its length]; nothing where none was found."""
        way = self.way(row)
        return self.trees.push[row, np.append(way, self.trees.solution[row])[1:]] if len(way) else np.zeros(0, np.uint8)

    def way(self, row: int) -> NDArray[np.int64]:
        """Return the nodes from a tree's first to the one before its solution, one for each push."""
        way: list[int] = []
        node = int(self.trees.solution[row])
        while node > 0:
            node = int(self.trees.parent[row, node])
            way.append(node)
        return np.array(way[::-1], np.int64)

    def boards(self, row: int | NDArray[np.int64], nodes: NDArray[np.int64]) -> BitBoards:
        """Return the states of nodes, [X], of a tree or of a tree each, [X]."""
        trees, rows = self.trees, np.broadcast_to(row, nodes.shape)
        return BitBoards(trees.wall[rows], trees.target[rows], trees.box[rows, nodes], trees.agent[rows, nodes])

    def judge(self, row: int) -> Verdicts:
        """Return what the search in a tree proved."""
        trees = self.trees
        node = np.flatnonzero(trees.expanded[row, : trees.nodes[row]])
        known, dead = np.zeros((2, len(node), 4), np.uint64)
        solvable, lost, searched = np.zeros((3, len(node)), np.bool_)
        verdicts = Verdicts(node, solvable, lost, known, dead, searched)
        judge(trees, row, *verdicts)
        return verdicts

    def state(self) -> State:
        """Return all trees."""
        return State(tensors={k: torch.from_numpy(signed(v)) for k, v in self.trees._asdict().items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        for name, column in self.trees._asdict().items():
            signed(column)[...] = state.tensors[name].numpy()
