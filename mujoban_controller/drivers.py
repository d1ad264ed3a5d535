"""What can drive the robots of a goal task: a controller, the scripted driver, a privileged network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.goal_features import goal_offsets, privileged_features
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_sim.goals import GoalKind
from mujoban_sim.interfaces import Controller, Memory, renew_rows
from mujoban_sim.oracles import DrivingGains, drive

Driver = Callable[[GoalTask], NDArray[np.float32]]
"""Torques in [-1, 1] for the task's current tick, [B, U]."""

SCRIPTED_GAINS = DrivingGains(
    roll_feed_forward=0.5, roll_gain=1.0, least_speed=0.0, lane_tolerance=0.3, look_ahead=0.5
)
"""Gains of the scripted teacher.

It makes up for damping, so it is faster than the oracle's defaults, and it stops at its goal. It bends back to its
lane smoothly instead of turning round 0.12 cells off it: a student that is not sure on which side of such a
threshold it is cannot imitate what flips there.
"""


HOLD_RADIUS = 0.06
"""Distance in cells from the centre within which the scripted teacher stands still when it is to hold."""


def scripted_driver(task: GoalTask) -> NDArray[np.float32]:
    """Return the scripted driver's torques, [B, 2]; it knows where everything is."""
    world, gains = task.world, SCRIPTED_GAINS
    torque = drive(world.goals, world.truth(), gains)
    # The course to a centre that is reached already is noise, which a student could only learn as such.
    offset = np.linalg.norm(goal_offsets(world)[:, :2], axis=1)
    holding = (world.goals.kind == GoalKind.HOLD) & (offset < HOLD_RADIUS)
    brake = np.stack([-gains.roll_gain * task.forward_speed, -gains.steer_damping * world.velocity[:, 2]], 1)
    return np.where(holding[:, None], np.clip(brake, -1.0, 1.0), torque).astype(np.float32)


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
