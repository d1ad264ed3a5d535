"""Levin tree search over pushes, guided by a planner network (Orseau et al. 2018), under the abstract rules.

A node is a state after a push; an edge is a legal push with the network's probability. Nodes are expanded in the order
of log(depth + 1) - sum of log-probabilities - weight * log p(alive): the policy says where to look, the dead-state head
what to leave. One network evaluation expands one node of every level that is still open (`forest.Forest`).

Boards are those of `mujoban_sokoban.bitboard`. Shapes: M levels, I = 8, T moves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mujoban_core.grid import CHANNELS, GRID_SIZE, Instruction
from mujoban_planner.boards import BitBoards, state_tensor
from mujoban_planner.forest import Forest
from mujoban_planner.forest_kernels import region_of
from mujoban_planner.heads import INTERIOR, as_said, verdicts
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.shortening import shorten
from mujoban_rl.compiled import CompiledGraph
from mujoban_rl.precision import autocast
from mujoban_sokoban.bitboard import SQUARES
from mujoban_sokoban.solver_labels import moves_of

_FIRST: Final = np.zeros(1, np.int64)
_WARM_UPS: Final = 3
"""Evaluations before one is captured: libraries choose their kernels in the first."""
Evaluation = Callable[[BitBoards], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""What `evaluate_boards` returns of M states."""


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
    n = len(starts.agent)
    forest = Forest(n, expansions, limit)
    forest.plant(np.arange(n), starts)
    evaluate = partial(evaluate_boards, planner)
    for _ in range(expansions):
        rows = np.flatnonzero(forest.open)
        if not rows.size:
            break
        grow(forest, rows, evaluate)
    return Found([_instructions(forest, starts, row) for row in range(n)], forest.expansions.copy())


def grow(forest: Forest, rows: NDArray[np.int64], evaluate: Evaluation) -> None:
    """Expand a node of each of the trees `rows`, which are open, by one evaluation."""
    nodes, boards = forest.pop(rows)
    push, alive = evaluate(boards)
    forest.expand(rows, nodes, push, alive)


def evaluate_boards(planner: LearnedPlanner, boards: BitBoards) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how promising pushes are, as log-probabilities, [M, 4, I * I], and log p(alive), [M]."""
    states = state_tensor(boards)
    if planner.compiled is not None and not planner.rereads and len(states) == 1:
        return _judge_one(planner.compiled, states.numpy())
    push, alive = _judge(planner, states.to(planner.device))
    return push.cpu().numpy(), alive.cpu().numpy()


@torch.inference_mode()
def _judge(planner: LearnedPlanner, states: Tensor) -> tuple[Tensor, Tensor]:
    output, _ = planner.read(states)
    alive = functional.logsigmoid(-output.dead[:, Instruction.STAY])
    push = output.push + verdicts(output)
    return push.flatten(2).float(), alive.float()


def _judge_one(decision: CompiledGraph, state: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what `_judge` does of a state, [1, N, N, 4], by the graph of a decision that has seen nothing before."""
    nothing = np.zeros((1, len(Instruction) - 1, INTERIOR, INTERIOR), np.float32)
    seen, caution = np.zeros(1, np.int64), np.array(1.0, np.float32)
    _, push, push_alive, alive = decision([state, seen, nothing, nothing, nothing, caution])
    return (push + as_said(push_alive)).reshape(1, len(Instruction) - 1, -1), alive


class GraphedEvaluation:
    """`evaluate_boards` of always as many states as a CUDA graph, of whatever weights the planner has by then.

    A few hundred small kernels follow each other at once, where launching each would take longer than it runs; so
    many processes can share a GPU.
    """

    def __init__(self, planner: LearnedPlanner, batch: int) -> None:
        """Capture the evaluation of `batch` states by a planner on a GPU."""
        self._states = torch.zeros(batch, GRID_SIZE, GRID_SIZE, len(CHANNELS), device=planner.device)
        stream = torch.cuda.Stream(planner.device)
        stream.wait_stream(torch.cuda.current_stream(planner.device))
        with torch.cuda.stream(stream), autocast(planner.device):
            for _ in range(_WARM_UPS):
                _judge(planner, self._states)
        torch.cuda.current_stream(planner.device).wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph), autocast(planner.device):
            self._push, self._alive = _judge(planner, self._states)

    @torch.inference_mode()
    def __call__(self, boards: BitBoards) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return what `evaluate_boards` returns."""
        self._states.copy_(state_tensor(boards))
        self._graph.replay()
        return self._push.cpu().numpy(), self._alive.cpu().numpy()


class LoneSearch:
    """A search in one level that takes a few steps at a time, together with others (`advance`)."""

    def __init__(self, start: BitBoards, expansions: int, limit: int) -> None:
        """Start from one state, with at most `expansions` evaluations and solutions of at most `limit` moves."""
        self.start, self.expansions = start, expansions
        self.forest = Forest(1, expansions, limit)
        self.forest.plant(_FIRST, start)

    @property
    def origin(self) -> NDArray[np.uint64]:
        """The state that it started from, for `boards_at`, [4]."""
        return np.array([column[0] for column in self.start], np.uint64)

    @property
    def spent(self) -> int:
        """Evaluations so far."""
        return int(self.forest.expansions[0])

    @property
    def open(self) -> bool:
        """Whether it may still find a solution."""
        return bool(self.forest.open[0]) and self.spent < self.expansions

    def concerns(self, boards: BitBoards) -> bool:
        """Return whether a state is that of the start but for the robot's place where it can walk."""
        start = self.start
        alike = all((x == y).all() for x, y in zip(start[:3], boards[:3], strict=True))
        return alike and _region(start) == _region(boards)

    def solution(self, agent: int) -> NDArray[np.int64]:
        """Return the instructions that solve the level from where the robot is, [T]; none where none were found."""
        return _instructions(self.forest, self.start._replace(agent=np.array([agent], np.uint8)), 0)


def boards_at(origin: NDArray[np.uint64]) -> BitBoards:
    """Return the one state of `LoneSearch.origin`."""
    wall, target, box, agent = origin[:, None]
    return BitBoards(wall, target, box, agent.astype(np.uint8))


def advance(
    searches: Sequence[LoneSearch], planner: LearnedPlanner, steps: int, seconds: float = math.inf
) -> int:
    """Let searches take so many steps, as far as they are open; return the evaluations that this took.

    After `seconds` no further step begins; the first always does.
    """
    total, end = 0, time.perf_counter() + seconds
    for step in range(steps):
        active = [search.forest for search in searches if search.open]
        if not active or (step > 0 and time.perf_counter() >= end):
            break
        popped = [forest.pop(_FIRST) for forest in active]
        columns = zip(*(boards for _, boards in popped), strict=True)
        push, alive = evaluate_boards(planner, BitBoards._make(np.concatenate(column) for column in columns))
        for i, (forest, (nodes, _)) in enumerate(zip(active, popped, strict=True)):
            forest.expand(_FIRST, nodes, push[i : i + 1], alive[i : i + 1])
        total += len(active)
    return total


def _region(boards: BitBoards) -> int:
    """Return the lowest square that the robot of a state can walk to."""
    return int(region_of(boards.wall[0], boards.box[0], int(boards.agent[0])))


def _instructions(forest: Forest, starts: BitBoards, row: int) -> NDArray[np.int64]:
    """Return the instructions of the solution that was found in a level, [T] or none."""
    start = (starts.box[row], int(starts.agent[row]))
    pushes = shorten(starts.wall[row], *start, forest.solution(row))
    # The robot may walk on from where it stands now, farther than where the search began.
    moves = np.zeros(forest.limit + SQUARES, np.int64)
    moves_of(~starts.wall[row], *start, pushes, np.random.default_rng(0), moves)
    return moves[: np.count_nonzero(moves)]
