"""The floor of every comparison: torques drawn at random."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mujoban_core.agent import Agent, AgentInput
from mujoban_core.bodies import BODIES
from mujoban_core.interfaces import Memory, counter_uniform


class RandomAgent(Agent):
    """Draws every torque evenly from [-1, 1]; sees o_pr only to know what robots, and how many, there are."""

    sees = ("proprio",)

    def initial_memory(self, batch: int) -> Memory:
        """Return seeds 0 and no draws yet, [B] each."""
        return self.initial_state(np.zeros(batch, np.int64))

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the seeds of the draws and their number so far, [B] each."""
        return np.asarray(seeds, np.int64), np.zeros(len(seeds), np.int64)

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, U], and the next state.

        Raises:
            ValueError: If no body has proprioception of that size.
        """
        seed, drawn = state
        assert inputs.proprio is not None
        size = _actuators(inputs.proprio.shape[1])
        draws = counter_uniform(seed[:, None], drawn[:, None] + np.arange(size))
        return (2.0 * draws - 1.0).astype(np.float32), (seed, drawn + size)


def _actuators(felt: int) -> int:
    """Return U of the body whose proprioception has so many values."""
    for body in BODIES.values():
        if body.proprio_size == felt:
            return body.action_size
    known = ", ".join(f"{body.proprio_size} ({body.name})" for body in BODIES.values())
    raise ValueError(f"proprioception of {felt} values: expected {known}")
