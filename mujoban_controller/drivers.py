"""What can drive the robots of a goal task: the scripted driver, a policy's own, or a controller with its memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mujoban_core.interfaces import Controller, Memory, renew_rows

if TYPE_CHECKING:  # the shipped controller is imported where there is no physics
    from mujoban_controller.goal_task import GoalTask

Driver: TypeAlias = "Callable[[GoalTask], NDArray[np.float32]]"
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
