"""Planner and controller as they explore, in the place of those that play: both draw what they say.

Shapes: B robots, M of them with a decision to take, U actuators.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.play import drawn_torque, steadied
from mujoban_core.interfaces import Controller, ControllerInput, Memory, Planner
from mujoban_planner.planner import LearnedPlanner, check_abstract_state


class DrawingPlanner(Planner):
    """Draws instructions from the policy of a network; it has none of the rules by which a learned planner decides.

    Memory: how often it was asked, int64 [B], so that its own decisions can be told from those of looking around.
    """

    def __init__(self, network: LearnedPlanner, generator: torch.Generator) -> None:
        """Draw with `generator`."""
        self.network, self._generator = network, generator

    def initial_memory(self, batch: int) -> Memory:
        """Return zeros."""
        return (np.zeros(batch, np.int64),)

    @torch.no_grad()
    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return an instruction for each state, [M] from [M, N, N, 4]."""
        check_abstract_state(abstract_state)
        chances = functional.softmax(self.network(torch.from_numpy(abstract_state)).policy, 1)
        return torch.multinomial(chances, 1, generator=self._generator)[:, 0].numpy(), (memory[0] + 1,)


class DrawingController(Controller):
    """Draws torques from the distribution of a network; those of every third robot deviate by `explore` at least.

    Those of a share of the robots are `steady`: the mean.
    """

    def __init__(
        self, network: VisuomotorController, generator: torch.Generator, explore: float, steady: float = 0.0
    ) -> None:
        """Draw with `generator`."""
        self.network, self._generator, self._explore, self._steady = network, generator, explore, steady

    def initial_memory(self, batch: int) -> Memory:
        """Return the network's."""
        return self.network.initial_memory(batch)

    @torch.no_grad()
    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques limited to [-1, 1], [B, U], and the next memory."""
        output = self.network(*self.network.to_tensors(inputs), memory=Recurrent(*state))
        mean, scale = output.action.mean[:, 0], steadied(output.action.scale[:, 0], self._steady)
        return drawn_torque(mean, scale, self._explore, self._generator), output.memory
