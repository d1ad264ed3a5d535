"""Decisions of the planner as they are learned from: n-step returns over instructions, however long each took.

A decision goes on until the next one. Nothing is dropped because an instruction failed: that is what the planner is to
learn of this controller. Where time ran out nobody knows what would have come, and what is not finished is forgotten.

Shapes: B robots, n decisions of a return, N = `grid.GRID_SIZE`, D decisions that are finished.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_planner.teacher import STEP_REWARD
from mujoban_rl.engine import State

FIELDS = ("state", "instruction", "reward", "bootstrap", "last")
"""Of a finished decision, as in `mujoban_planner.discrete_mpo.MPOBatch`."""
_STATE = (GRID_SIZE, GRID_SIZE, len(CHANNELS))
_CHANGING = ("_state", "_instruction", "_reward", "_factor", "_count")


class DecisionLog:
    """Collects the rewards of the last n decisions of every robot."""

    def __init__(self, batch: int, n_step: int, discount: float) -> None:
        """Begin before the first decision."""
        self._n, self._discount = n_step, discount
        # The oldest decision is at place 0; those from `_count` on mean nothing.
        self._state = np.zeros((batch, n_step, *_STATE), np.float32)
        self._instruction = np.zeros((batch, n_step), np.int64)
        self._reward = np.zeros((batch, n_step), np.float32)
        self._factor = np.zeros((batch, n_step), np.float32)
        self._count = np.zeros(batch, np.int64)
        self._finished: dict[str, list[NDArray]] = {name: [] for name in FIELDS}

    def decided(self, rows: NDArray[np.int64], state: NDArray[np.float32], instruction: NDArray[np.int64]) -> None:
        """Note the decisions of some robots: estimates, [M, N, N, 4], and instructions, [M]."""
        self._factor[rows] *= self._discount
        for row, seen, said in zip(rows.tolist(), state, instruction.tolist(), strict=True):
            if self._count[row] == self._n:
                self._finish(row, 0, float(self._factor[row, 0]), seen)
                for values in (self._state, self._instruction, self._reward, self._factor):
                    values[row, :-1] = values[row, 1:]
                self._count[row] -= 1
            last = int(self._count[row])
            self._state[row, last], self._instruction[row, last] = seen, said
            self._reward[row, last], self._factor[row, last] = 0.0, 1.0
            self._reward[row, : last + 1] += self._factor[row, : last + 1] * STEP_REWARD
            self._count[row] += 1

    def rewarded(self, reward: NDArray[np.float32]) -> None:
        """Credit what a tick earned, [B], to the decisions that led to it."""
        self._reward += self._factor * reward[:, None]

    def ended(self, terminated: NDArray[np.bool_], truncated: NDArray[np.bool_]) -> None:
        """End episodes, [B]: for good, or because time ran out."""
        for row in np.flatnonzero(terminated).tolist():
            for place in range(int(self._count[row])):
                self._finish(row, place, 0.0, self._state[row, place])
        over = terminated | truncated
        self._count[over], self._factor[over] = 0, 0.0

    def _finish(self, row: int, place: int, bootstrap: float, last: NDArray[np.float32]) -> None:
        values = (
            self._state[row, place], self._instruction[row, place], self._reward[row, place],
            np.float32(bootstrap), last,
        )  # fmt: skip
        for name, value in zip(FIELDS, values, strict=True):
            self._finished[name].append(np.array(value))

    def take(self) -> dict[str, NDArray]:
        """Return the decisions that were finished since the last call, [D, ...] each."""
        shapes = {"state": _STATE, "last": _STATE}
        types = {"instruction": np.int64}
        arrays = {
            name: np.array(values, types.get(name, np.float32)).reshape(-1, *shapes.get(name, ()))
            for name, values in self._finished.items()
        }
        self._finished = {name: [] for name in FIELDS}
        return arrays

    def state(self) -> State:
        """Return what is unfinished; call it when everything finished has been taken."""
        return State(tensors={name: torch.from_numpy(getattr(self, name)) for name in _CHANGING})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        for name in _CHANGING:
            setattr(self, name, state.tensors[name].numpy())
