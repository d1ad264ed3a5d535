"""What can drive the robots of a goal task: a controller, the scripted driver, a privileged network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.goal_features import goal_offsets, privileged_features
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_sim.goals import GoalKind, GoalTracker
from mujoban_sim.interfaces import Controller, Memory, renew_rows
from mujoban_sim.oracles import DrivingGains, drive

Driver = Callable[[GoalTask], NDArray[np.float32]]
"""Torques in [-1, 1] for the task's current tick, [B, U]."""

SCRIPTED_GAINS = DrivingGains(
    roll_feed_forward=0.5, roll_gain=1.0, braking=3.3, lane_tolerance=0.3, look_ahead=0.5
)
"""Gains of the scripted teacher.

It makes up for damping, so it is faster than the oracle's defaults. It bends back to its lane smoothly instead of
turning round 0.12 cells off it: a student that is not sure on which side of such a threshold it is cannot imitate
what flips there. It never stops short of its goal, since a student that does, by mistake, would stand there for good.
"""
HOLD_RADIUS = 0.06
"""Distance in cells from the centre within which the scripted teacher stands still when it is to hold."""
OVERSHOT = 0.1
"""Cells past the goal of a move beyond which the scripted teacher comes back."""


def scripted_driver(task: GoalTask, offset: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
    """Return the scripted driver's torques, [B, 2]; it knows where everything is.

    Args:
        task: Where it drives.
        offset: Metres by which it misses its targets, [B, 2].
    """
    world, gains = task.world, SCRIPTED_GAINS
    goals = GoalTracker(world.batch, cell_size=world.body.cell_size)
    goals.restore(world.goals.memory())
    to_target = goal_offsets(world)[:, :2]
    overshot = (goals.kind == GoalKind.MOVE) & (to_target[:, 0] < -OVERSHOT)
    goals.kind[overshot] = GoalKind.HOLD
    if offset is not None:
        goals.robot_target += offset
    torque = drive(goals, world.truth(), gains)
    # The course to a centre that is reached already is noise, which a student could only learn as such.
    holding = (goals.kind == GoalKind.HOLD) & (np.linalg.norm(to_target, axis=1) < HOLD_RADIUS)
    brake = np.stack([-gains.roll_gain * task.forward_speed, -gains.steer_damping * world.velocity[:, 2]], 1)
    return np.where(holding[:, None], np.clip(brake, -1.0, 1.0), torque).astype(np.float32)


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
