"""The teacher of imitation: the solver's demonstrations as labelled states.

Every state on the way of a demonstration becomes a sample. Every other push that is possible on the way is judged by
the solver: its proof that no solution is left labels the push, and makes a sample of the dead state. What cannot be
decided within the node budget teaches nothing.

Shapes: B levels, S samples, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.grid import GRID_SIZE, OFFSETS_RC, Instruction
from mujoban_planner.boards import BitBoards, bit_boards, take_levels
from mujoban_planner.samples import EVERY_INSTRUCTION, Samples, concatenate, unlabelled
from mujoban_sokoban.bitboard import SIDE, SQUARE_STEP, SQUARES, bit, flood, pushable
from mujoban_sokoban.levels import LevelBatch
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD
from mujoban_sokoban.solver import Demonstrations, Status, demonstrations, solve_batch
from mujoban_sokoban.solver_labels import ABSENT

DISCOUNT: Final = 0.99
"""Discount of the planner's returns, per instruction."""
STEP_REWARD: Final = -0.01
"""Reward of every planner step (paper C.2)."""
HOPELESS: Final = STEP_REWARD / (1.0 - DISCOUNT)
"""Return where nothing but the cost of moving is left."""
_QUICK_WEIGHT: Final = 2.0
"""Weight of the solver's heuristic where only solvability matters."""
DEAD_SHARE: Final = 0.05
"""Share of the dead states behind judged pushes that become samples of their own; there are many."""


class Teacher:
    """Labels states by solving them."""

    def __init__(self, max_nodes: int = 60_000, trial_nodes: int = 15_000) -> None:
        """Allow `max_nodes` states for a demonstration and `trial_nodes` to judge a wrong push."""
        self.max_nodes = max_nodes
        self.trial_nodes = trial_nodes

    def judge(self, levels: LevelBatch) -> NDArray[np.int64]:
        """Return the solver's status of each state, [B]."""
        return solve_batch(levels, max_nodes=self.max_nodes, weight=_QUICK_WEIGHT).status

    def moves(self, levels: LevelBatch) -> NDArray[np.int64]:
        """Return how many moves a short, if not the shortest, solution of each state takes, [B]; -1 without one."""
        solutions = solve_batch(levels, max_nodes=self.max_nodes, weight=_QUICK_WEIGHT)
        return np.where(solutions.status == Status.SOLVED, solutions.length, -1)

    def demonstrate(
        self, levels: LevelBatch, rng: np.random.Generator, *, judged: float = 1.0, keep: int | None = None
    ) -> Samples:
        """Return the samples of a demonstration from each state.

        Args:
            levels: States; unsolvable ones become a dead sample each.
            rng: Chooses among equal walks and what is judged.
            judged: Share of the arrangements of boxes in which every push that is possible is judged.
            keep: States kept of each demonstration, from its start; all by default.
        """
        found = demonstrations(levels, rng=rng, max_nodes=self.max_nodes)
        dead = take_levels(levels, found.status == Status.UNSOLVABLE)
        parts = [label_dead(bit_boards(dead))]
        if len(found.level):
            first = np.searchsorted(found.level, found.level)  # Shape [S], where each state's demonstration begins
            kept = np.ones(len(first), np.bool_) if keep is None else np.arange(len(first)) - first < keep
            samples, upcoming = label_demonstrations(levels, found)
            pushes = np.unique(upcoming[kept])
            pushes = pushes[rng.random(len(pushes)) < judged]
            lost = self._judge_pushes(levels, found, samples, pushes)
            # Until the next push the boxes stay where they are, and so do the verdicts.
            samples.push_known[:], samples.push_dead[:] = samples.push_known[upcoming], samples.push_dead[upcoming]
            shown = samples.take(kept)
            parts += [judge_instructions(shown), lost.take(rng.random(len(lost.agent)) < DEAD_SHARE)]
        return concatenate(parts)

    def _judge_pushes(
        self, levels: LevelBatch, found: Demonstrations, samples: Samples, rows: NDArray[np.int64]
    ) -> Samples:
        """Judge every push that is possible in states `rows`, note it in `samples` in place; return dead states."""
        states = samples.take(rows)
        options = reachable_pushes(states.boards) & ~states.push_known
        bits = np.unpackbits(np.ascontiguousarray(options).view(np.uint8), axis=1, bitorder="little")
        state, push = np.nonzero(bits)
        direction, square = push // SQUARES, push % SQUARES
        pushed = _push(_levels_of(levels, found, rows[state]), square, direction)
        status = solve_batch(pushed, max_nodes=self.trial_nodes, weight=_QUICK_WEIGHT).status
        board = np.uint64(1) << square.astype(np.uint64)
        decided, lost = status != Status.BUDGET, status == Status.UNSOLVABLE
        np.bitwise_or.at(samples.push_known, (rows[state[decided]], direction[decided]), board[decided])
        np.bitwise_or.at(samples.push_dead, (rows[state[lost]], direction[lost]), board[lost])
        return label_dead(bit_boards(take_levels(pushed, lost)))


def label_deadly(levels: LevelBatch, instruction: NDArray[np.int64]) -> Samples:
    """Return samples that say only that an instruction, a push, [B], leads from a solvable to a dead state."""
    samples = unlabelled(bit_boards(levels))
    direction = instruction - 1
    board = np.uint64(1) << (samples.agent + SQUARE_STEP[direction]).astype(np.uint64)
    for pushes in (samples.push_known, samples.push_dead):
        pushes[np.arange(len(board)), direction] = board
    mask = (1 << instruction).astype(np.uint8)
    return samples._replace(dead_known=mask | np.uint8(1 << Instruction.STAY), dead=mask)


def label_dead(boards: BitBoards) -> Samples:
    """Return samples that say that no solution is left in these states, nor after any instruction."""
    samples = unlabelled(boards)
    every = np.full(len(boards.agent), EVERY_INSTRUCTION, np.uint8)
    value = np.full(len(boards.agent), HOPELESS, np.float32)
    return samples._replace(value=value, dead_known=every, dead=every.copy())


def _levels_of(levels: LevelBatch, found: Demonstrations, rows: NDArray[np.int64]) -> LevelBatch:
    """Return states of demonstrations as levels."""
    level = found.level[rows]
    boxes = found.boxes[rows].astype(np.int64)
    cells = np.stack([boxes // GRID_SIZE, boxes % GRID_SIZE], -1)
    cells[boxes == ABSENT] = -1
    player = found.player[rows].astype(np.int64)
    return LevelBatch(
        levels.wall[level], levels.target[level], cells, np.stack([player // GRID_SIZE, player % GRID_SIZE], -1)
    )


def _push(levels: LevelBatch, square: NDArray[np.int64], direction: NDArray[np.int64]) -> LevelBatch:
    """Return states after pushes that are possible, of the box on each square, [B], in each direction, [B]."""
    cell = np.stack([square // SIDE + 1, square % SIDE + 1], -1)
    pushed = (levels.boxes == cell[:, None]).all(2)  # Shape [B, K]
    step = OFFSETS_RC[direction + 1]
    boxes = np.where(pushed[:, :, None], levels.boxes + step[:, None], levels.boxes)
    return levels._replace(boxes=boxes, player=cell)


def label_demonstrations(levels: LevelBatch, found: Demonstrations) -> tuple[Samples, NDArray[np.int64]]:
    """Return the samples of demonstrations, and the row in which the next push of each is executed, [S]."""
    rows = np.arange(len(found.level))
    boards = bit_boards(_levels_of(levels, found, rows))
    samples = unlabelled(boards)
    right = np.packbits(found.optimal, axis=1, bitorder="little")[:, 0]
    pushing = (right & possible_pushes(boards)) != 0
    direction = found.optimal[:, 1:].argmax(1)
    square = boards.agent.astype(np.int64) + SQUARE_STEP[direction]
    # A demonstration ends with a push, so that every state has a next one.
    upcoming = np.minimum.accumulate(np.where(pushing, rows, len(rows))[::-1])[::-1]
    next_push = (4 * square + direction)[upcoming].astype(np.uint8)
    # What the demonstration does loses nothing.
    samples.push_known[rows[pushing], direction[pushing]] = np.uint64(1) << square[pushing].astype(np.uint64)
    labelled = samples._replace(
        right=right,
        plan=np.ascontiguousarray(found.plan[:, 1:-1, 1:-1]).reshape(len(rows), SIDE * SIDE),
        value=_returns(boards, found.steps_to_go),
        next_push=next_push,
    )
    return labelled, upcoming


def judge_instructions(samples: Samples) -> Samples:
    """Return samples of demonstrations with the verdicts on instructions that follow from those on pushes."""
    pushing = possible_pushes(samples.boards)
    known = EVERY_INSTRUCTION & ~pushing  # Walking loses nothing
    dead = np.zeros_like(samples.dead)
    for direction, step in enumerate(SQUARE_STEP.tolist()):
        # Beyond the edge there is no box, so whatever square stands there has no verdict.
        ahead = np.clip(samples.agent.astype(np.int64) + step, 0, SQUARES - 1).astype(np.uint64)
        beside = (pushing >> (direction + 1)) & 1
        for mask, pushes in ((known, samples.push_known), (dead, samples.push_dead)):
            mask |= ((pushes[:, direction] >> ahead).astype(np.uint8) & beside) << np.uint8(direction + 1)
    return samples._replace(dead_known=known | samples.right, dead=dead)


def reachable_pushes(boards: BitBoards) -> NDArray[np.uint64]:
    """Return the boxes that can be pushed now in each direction, after any walk, as boards, [S, 4]."""
    pushes = np.empty((len(boards.agent), len(Instruction) - 1), np.uint64)
    _fill_reachable(*boards, pushes)
    return pushes


@njit(cache=True, nogil=True)
def _fill_reachable(
    wall: NDArray[np.uint64],
    target: NDArray[np.uint64],
    box: NDArray[np.uint64],
    agent: NDArray[np.uint8],
    out: NDArray[np.uint64],
) -> None:
    for i in range(len(agent)):
        free = ~(wall[i] | box[i])
        reached = flood(bit(agent[i]), free)
        for direction in range(4):
            out[i, direction] = pushable(reached, free, box[i], direction)


def possible_pushes(boards: BitBoards) -> NDArray[np.uint8]:
    """Return the mask of the instructions that push a box now, [S]."""
    row, column = boards.agent.astype(np.int64) // SIDE, boards.agent.astype(np.int64) % SIDE
    mask = np.zeros(len(row), np.uint8)
    for instruction in list(Instruction)[1:]:
        d_row, d_column = OFFSETS_RC[instruction].tolist()
        inside = (np.minimum(row + 2 * d_row, column + 2 * d_column) >= 0) & (
            np.maximum(row + 2 * d_row, column + 2 * d_column) < SIDE
        )
        ahead = np.where(inside, (row + d_row) * SIDE + column + d_column, 0).astype(np.uint64)
        beyond = np.where(inside, (row + 2 * d_row) * SIDE + column + 2 * d_column, 0).astype(np.uint64)
        pushes = inside & ((boards.box >> ahead) & 1 == 1) & (((boards.box | boards.wall) >> beyond) & 1 == 0)
        mask |= pushes.astype(np.uint8) << np.uint8(instruction)
    return mask


def _returns(boards: BitBoards, steps_to_go: NDArray[np.int16]) -> NDArray[np.float32]:
    """Return the discounted return of demonstrations from each of their states, [S]."""
    on_target = np.bitwise_count(boards.box & boards.target).astype(np.float64)
    boxes = np.bitwise_count(boards.box).astype(np.float64)
    last = steps_to_go == 1
    after = np.where(last, boxes, np.append(on_target[1:], 0.0))
    reward = STEP_REWARD + BOX_REWARD * (after - on_target) + SOLVED_REWARD * last
    value = reward.copy()
    # From the ends backwards, all demonstrations at once.
    for steps in range(2, int(steps_to_go.max(initial=1)) + 1):
        rows = np.flatnonzero(steps_to_go == steps)
        value[rows] = reward[rows] + DISCOUNT * value[rows + 1]
    return value.astype(np.float32)
