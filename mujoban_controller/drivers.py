"""What can drive the robots of a goal task: a controller, the scripted driver, a privileged network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.goal_features import privileged_features
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.scripted import scripted_driver
from mujoban_core.interfaces import Controller, Memory, renew_rows

Driver = Callable[[GoalTask], NDArray[np.float32]]
"""Torques in [-1, 1] for the task's current tick, [B, U]."""


class WanderingDriver:
    """The scripted driver with targets that wander, which shows a student positions off lanes and centres."""

    def __init__(self, rng: np.random.Generator, deviation: float = 0.12, memory: float = 0.97) -> None:
        """Wander with a standard `deviation` in cells and a share of `memory` kept from tick to tick."""
        self._rng, self._deviation, self._memory = rng, deviation, memory
        self._offset: NDArray[np.float64] | None = None

    def __call__(self, task: GoalTask) -> NDArray[np.float32]:
        """Return torques, [B, 2]."""
        size = task.world.body.cell_size
        noise = self._rng.normal(0.0, self._deviation * size, (task.world.batch, 2))
        if self._offset is None:
            self._offset = noise
        self._offset = self._memory * self._offset + (1.0 - self._memory**2) ** 0.5 * noise
        return scripted_driver(task, self._offset)


class ControllerDriver:
    """A controller with its memory, which is cleared where episodes begin."""

    def __init__(self, controller: Controller) -> None:
        """Drive with `controller`."""
        self._controller = controller
        self._state: Memory | None = None

    def __call__(self, task: GoalTask) -> NDArray[np.float32]:
        """Return the controller's torques, [B, U]."""
        controller, batch = self._controller, task.world.batch
        fresh = controller.initial_memory(batch)
        state = fresh if self._state is None else renew_rows(self._state, fresh, task.first)
        torque, self._state = controller.step(task.observe(camera=not controller.privileged), state)
        return torque


class PrivilegedDriver:
    """The mean torques of a privileged policy."""

    def __init__(self, policy: PrivilegedPolicy) -> None:
        """Drive with `policy`."""
        self._policy = policy

    @torch.inference_mode()
    def __call__(self, task: GoalTask) -> NDArray[np.float32]:
        """Return the policy's mean torques limited to [-1, 1], [B, U]."""
        state = torch.from_numpy(privileged_features(task.world, task.elapsed))
        return self._policy(state).mean.clamp(-1.0, 1.0).numpy()
