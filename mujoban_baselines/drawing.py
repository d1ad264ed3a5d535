"""Agents that play as they explored: by torques drawn from their distribution, not by its mean.

Shapes: B robots, K parts of the noise, U actuators.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_baselines.networks import RecurrentAgent
from mujoban_core.agent import Agent, AgentInput
from mujoban_core.interfaces import Memory, counter_uniform
from mujoban_rl.exploration import Exploration, fade, kept, mix


class Drawing(Agent):
    """A recurrent agent whose torques are drawn by the noise of its exploration.

    State: the agent's; the parts of the noise, float32 [B, K, U]; seeds, and draws so far, int64 [B] each.
    """

    def __init__(self, inner: RecurrentAgent, noise: Exploration) -> None:
        """Draw the torques of `inner`, which is asked once in `inner.repeat` ticks.

        Raises:
            ValueError: If there is no such noise.
        """
        self.inner, self.sees, self.config = inner, inner.sees, inner.config
        self._keeps = kept(noise, inner.repeat)
        self._shape = (len(self._keeps), inner.action_size)

    def initial_memory(self, batch: int) -> Memory:
        """Return the state at the start of `batch` episodes, all of seed 0."""
        return self.initial_state(np.zeros(batch, np.int64))

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the state at the start of episodes with the given seeds, [B]; the noise is as strong as later."""
        seeds, drawn = np.asarray(seeds, np.int64), np.zeros(len(seeds), np.int64)
        parts, drawn = self._normal(seeds, drawn)
        return (*self.inner.initial_state(seeds), parts.numpy(), seeds, drawn)

    def _normal(self, seeds: NDArray[np.int64], drawn: NDArray[np.int64]) -> tuple[Tensor, NDArray[np.int64]]:
        """Return standard normal draws, [B, K, U], and how many there have been since."""
        size = int(np.prod(self._shape))
        even = counter_uniform(seeds[:, None], drawn[:, None] + np.arange(size))
        # The ends of (0, 1) are infinitely far out.
        normal = torch.special.ndtri(torch.from_numpy(even).clamp(1e-12, 1.0 - 1e-12))
        return normal.view(-1, *self._shape).float(), drawn + size

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques drawn in this tick, [B, U], and the next state."""
        *own, parts, seeds, drawn = state
        torque, after = self.inner.respond(inputs, tuple(own))
        fresh, drawn = self._normal(seeds, drawn)
        noise = fade(torch.from_numpy(parts), fresh, self._keeps)
        taken = torque.at(mix(noise).to(torque.mean.device)).clamp(-1.0, 1.0)
        return taken.cpu().numpy(), (*after, noise.numpy(), seeds, drawn)
