"""Agents that decide in some ticks only (action repeat).

Shapes: B robots, M of them, U actuators.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mujoban_core.agent import Agent, AgentInput
from mujoban_core.interfaces import Memory, put_rows, take_rows
from mujoban_core.ranges import check_counts


class Repeating(Agent):
    """An agent whose torques are held for some ticks, from an episode's first on; in between it is not asked.

    State: the other agent's; the torques in force, [B, U]; ticks of the episode so far, int64 [B].
    """

    def __init__(self, inner: Agent, ticks: int, actuators: int) -> None:
        """Hold for so many ticks what `inner` says to each of U actuators.

        Raises:
            ValueError: If that is not at least one.
        """
        self.inner, self.ticks, self._actuators = inner, ticks, actuators
        check_counts(self, "ticks")
        self.sees = inner.sees
        self.config = getattr(inner, "config", {})  # by which programs tell the body that it was trained for

    def initial_memory(self, batch: int) -> Memory:
        """Return the state at the start of `batch` episodes, all of seed 0."""
        return self.initial_state(np.zeros(batch, np.int64))

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the state at the start of episodes with the given seeds, [B]."""
        rest = np.zeros((len(seeds), self._actuators), np.float32)
        return (*self.inner.initial_state(seeds), rest, np.zeros(len(seeds), np.int64))

    def robots_looking(self, state: Memory) -> NDArray[np.bool_]:
        """Return which robots are asked in the coming tick, [B]."""
        return state[-1] % self.ticks == 0

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, U], and the next state."""
        *own, held, tick = state
        inner, rows = tuple(own), np.flatnonzero(self.robots_looking(state))
        if rows.size:
            seen = AgentInput(**{name: getattr(inputs, name)[rows] for name in self.sees})
            torque, after = self.inner.step(seen, take_rows(inner, rows))
            inner = put_rows(inner, rows, after)
            (held,) = put_rows((held,), rows, (torque,))
        return held.copy(), (*inner, held, tick + 1)
