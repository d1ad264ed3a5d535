"""Thousands of Sokoban levels at once as a task of pushes: an option walks to a box's side and pushes it.

The rules and rewards are those of `mujoban_sokoban.rules`, move by move, which the tests hold it to; the walk costs
what its moves cost. Only pushes that are possible now can be chosen. Numba over 64-bit boards, on a CPU.

Shapes: B levels, M rows, D = 4 directions, I = 8; a push is the flat index 64 * direction + square of its box into
[D, I, I].
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import BitBoards, signed
from mujoban_planner.forest_kernels import hopeless
from mujoban_planner.teacher import STEP_REWARD, reachable_pushes
from mujoban_rl.engine import State
from mujoban_sokoban.bitboard import NONE, SQUARE_STEP, SQUARES, bit, flood, pushable, pushed
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD
from mujoban_sokoban.solver_labels import UNREACHED, walk_distances
from mujoban_sokoban.solver_search import dead_squares, push_distances

PUSHES: Final = 4 * SQUARES
"""Pushes that a state may have."""


class PushStep(NamedTuple):
    """Outcome of a push, [B] each."""

    reward: NDArray[np.float32]
    """Environment's reward during walk and push, plus `STEP_REWARD` for each of their moves."""
    solved: NDArray[np.bool_]
    """Whether the level is solved."""
    terminated: NDArray[np.bool_]
    """Whether nothing more can be won: solved, without a further push, or hopeless."""
    truncated: NDArray[np.bool_]
    """Whether the move limit ended the episode, perhaps on the way to the box, and nothing else did."""
    moves: NDArray[np.int64]
    """Moves of walk and push."""

    @property
    def over(self) -> NDArray[np.bool_]:
        """Whether the episode is."""
        return self.terminated | self.truncated


class PushEnvironment:
    """A batch of levels under the abstract rules, a push at a time.

    Observation: `boards`, or abstract states by `boards.state_tensor`. Action: a push, int64 [B] in 0..255, one of
    `possible()`. Reward: +1 / -1 for a box pushed onto / off a target, +10 when solved, -0.01 per move. An episode
    that is solved or out of moves stays as it is until `reset_to`.

    An episode also ends where no solution is left at sight (a box that can reach no target, or is frozen off the
    targets), since nothing is to be learned from what follows: `reset_to` is due then.
    """

    def __init__(self, batch: int, *, move_limit: int = MOVE_LIMIT) -> None:
        """Make room for `batch` levels; `reset_to` fills them.

        Args:
            batch: B.
            move_limit: Moves after which an episode is over.
        """
        self.batch, self.move_limit = batch, move_limit
        empty = np.zeros(batch, np.uint64)
        self.boards = BitBoards(empty, empty.copy(), empty.copy(), np.zeros(batch, np.uint8))
        self.moves = np.zeros(batch, np.int64)
        """Moves of the episode so far, [B]."""
        self._dead = empty.copy()  # squares from which no target can be reached

    def reset_to(self, rows: NDArray[np.int64], boards: BitBoards) -> None:
        """Start from M states in the given rows, [M]."""
        for column, values in zip(self.boards, boards, strict=True):
            column[rows] = values
        self.moves[rows] = 0
        _find_dead(self.boards.wall, self.boards.target, rows, self._dead)

    def possible(self) -> NDArray[np.bool_]:
        """Return which pushes are possible now, [B, 256]; none for a robot that is shut in."""
        return possible_masks(self.boards)

    def step(self, push: NDArray[np.int64]) -> PushStep:
        """Walk to the side of a box and push it, in every level, [B].

        Raises:
            ValueError: If the pushes have another shape, or one is not possible.
        """
        if push.shape != (self.batch,):
            raise ValueError(f"pushes of shape {push.shape}: expected ({self.batch},)")
        reward = np.zeros(self.batch, np.float32)
        solved, terminated, truncated = np.zeros((3, self.batch), np.bool_)
        step = PushStep(reward, solved, terminated, truncated, np.zeros(self.batch, np.int64))
        wrong = _step(*self.boards, self._dead, self.moves, self.move_limit, push, *step)
        if wrong >= 0:
            raise ValueError(f"push {push[wrong]} in level {wrong} of the batch: expected one of `possible()`")
        return step

    def state(self) -> State:
        """Return the states of all levels."""
        columns = {**self.boards._asdict(), "moves": self.moves, "dead": self._dead}
        return State(tensors={name: torch.from_numpy(signed(column).copy()) for name, column in columns.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        columns = {**self.boards._asdict(), "moves": self.moves, "dead": self._dead}
        for name, column in columns.items():
            signed(column)[:] = state.tensors[name].numpy()


def possible_masks(boards: BitBoards) -> NDArray[np.bool_]:
    """Return which pushes are possible in M states after any walk, [M, 256]."""
    pushes = reachable_pushes(boards).astype("<u8").view(np.uint8)
    return np.unpackbits(pushes, axis=1, bitorder="little").view(np.bool_)


@njit(cache=True, nogil=True)
def _find_dead(
    wall: NDArray[np.uint64], target: NDArray[np.uint64], rows: NDArray[np.int64], dead: NDArray[np.uint64]
) -> None:
    for i in range(len(rows)):
        row = np.int64(rows[i])
        dead[row] = dead_squares(push_distances(~wall[row], target[row]))


@njit(cache=True, nogil=True)
def _step(
    wall: NDArray[np.uint64],
    target: NDArray[np.uint64],
    box: NDArray[np.uint64],
    agent: NDArray[np.uint8],
    dead: NDArray[np.uint64],
    total: NDArray[np.int64],
    limit: int,
    push: NDArray[np.int64],
    reward: NDArray[np.float32],
    solved: NDArray[np.bool_],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    moves: NDArray[np.int64],
) -> int:
    """Push in every level; return the first in which that is not possible, or -1."""
    distance = np.empty(SQUARES, np.int8)
    for i in range(len(agent)):
        if box[i] == target[i] or total[i] >= limit:
            solved[i] = terminated[i] = box[i] == target[i]
            truncated[i] = not solved[i]
            continue
        free = ~(wall[i] | box[i])
        direction, square = push[i] // SQUARES, push[i] % SQUARES
        if not 0 <= push[i] < PUSHES or pushable(free, free, box[i], direction) & bit(square) == NONE:
            return i
        walk_distances(agent[i], free, distance)
        walk = np.int64(distance[square - SQUARE_STEP[direction]])
        if walk == UNREACHED:
            return i
        moves[i] = min(walk + 1, limit - total[i])
        total[i] += moves[i]
        reward[i] = STEP_REWARD * moves[i]
        if moves[i] <= walk:  # the limit came on the way
            truncated[i] = True
            continue
        to = square + SQUARE_STEP[direction]
        gain = np.int64(target[i] & bit(to) != NONE) - np.int64(target[i] & bit(square) != NONE)
        reward[i] += BOX_REWARD * gain
        box[i], agent[i] = pushed(box[i], square, direction), square
        solved[i] = box[i] == target[i]
        reward[i] += SOLVED_REWARD * solved[i]
        free = ~(wall[i] | box[i])
        reached = flood(bit(square), free)
        further = NONE
        for way in range(4):
            further |= pushable(reached, free, box[i], way)
        lost = further == NONE or hopeless(box[i], wall[i], target[i], dead[i])
        terminated[i] = solved[i] or lost
        truncated[i] = total[i] >= limit and not terminated[i]
    return -1
