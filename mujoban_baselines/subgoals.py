"""Structured exploration (paper D.2): subgoals that are adjacent abstract states, drawn at random.

Shapes: B robots, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import AGENT, CHANNELS, GRID_SIZE, Instruction
from mujoban_core.interfaces import counter_uniform
from mujoban_sokoban.rules import abstract_successor

SUBGOAL_LIMIT: Final = 50
"""Steps after which a subgoal that was not reached gives way to another."""
SUBGOAL_REWARD: Final = 0.1
"""Pseudo reward for reaching one."""

_STREAM: Final = 0x5B60A1
"""Sets their random stream apart from that of torques drawn by the same seed."""
_MOVES: Final = tuple(direction for direction in Instruction if direction != Instruction.STAY)


class Subgoals(NamedTuple):
    """The subgoals in force, and what the next ones are drawn with."""

    target: NDArray[np.bool_]
    """Abstract state to reach, [B, N, N, 4]."""
    age: NDArray[np.int64]
    """Steps that each has had, [B]."""
    seed: NDArray[np.int64]
    """Of their random streams, [B]."""
    drawn: NDArray[np.int64]
    """Subgoals so far, [B]."""

    @classmethod
    def none_yet(cls, seeds: NDArray[np.int64]) -> Subgoals:
        """Return what holds before the first tick of episodes with the given random streams, [B]."""
        b = len(seeds)
        target = np.zeros((b, GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.bool_)
        streams = np.asarray(seeds, np.int64) ^ _STREAM
        return cls(target, np.full(b, SUBGOAL_LIMIT, np.int64), streams, np.zeros(b, np.int64))

    def reached(self, state: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return whether abstract states, [B, N, N, 4], are the subgoals, [B]."""
        return ((state > 0.5) == self.target).all((1, 2, 3))

    def over(self, state: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return where, in these abstract states, another subgoal is due, [B]."""
        return self.reached(state) | (self.age >= SUBGOAL_LIMIT)

    def renewed(self, state: NDArray[np.float32]) -> Subgoals:
        """Return the subgoals for a tick that begins in these abstract states, [B, N, N, 4]."""
        due = np.flatnonzero(self.over(state))
        target, age, drawn = self.target.copy(), self.age.copy(), self.drawn.copy()
        draws = counter_uniform(self.seed[due], drawn[due])
        for row, draw in zip(due.tolist(), draws.tolist(), strict=True):
            target[row] = adjacent_state(state[row] > 0.5, draw)
        age[due] = 0
        drawn[due] += 1
        return Subgoals(target, age, self.seed, drawn)

    def aged(self, steps: int = 1) -> Subgoals:
        """Return them after so many more steps."""
        return self._replace(age=self.age + steps)


def adjacent_state(state: NDArray[np.bool_], draw: float) -> NDArray[np.bool_]:
    """Return one of the states to which a move leads, by a draw from [0, 1); a robot that can go nowhere stays."""
    if state[..., AGENT].sum() != 1:
        return state
    successors = [abstract_successor(state, move) for move in _MOVES]
    others = [successor for successor in successors if (successor != state).any()]
    return others[int(draw * len(others))] if others else state
