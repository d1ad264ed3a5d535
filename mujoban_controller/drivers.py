"""What can drive the robots of a goal task: a controller, the scripted driver, a privileged network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.goal_task import GoalTask
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.interfaces import Controller, Memory, renew_rows

Driver = Callable[[GoalTask], NDArray[np.float32]]
"""Torques in [-1, 1] for the task's current tick, [B, U]."""


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
        action = self._policy(torch.from_numpy(task.features())).mean.clamp(-1.0, 1.0)
        return task.torque_of(action.numpy())
