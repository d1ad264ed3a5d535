"""A privileged policy in the place of the learned controller: an oracle for every body, in rollouts and the graph.

Shapes: B robots, U actuators.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.goal_features import privileged_features
from mujoban_controller.goal_view import StoredView
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.bodies import get_body
from mujoban_core.grid import CONTROL_PERIOD, INSTRUCTION_LIMIT, WALL
from mujoban_core.interfaces import Controller, ControllerInput, Memory
from mujoban_sim.goals import GoalKind, GoalTracker
from mujoban_sim.oracles import cells_of_boxes, follow_goals


class PrivilegedController(Controller):
    """The mean torques of a privileged policy, from ground truth.

    Ground truth has no speeds of boxes; they follow from where a pushed box was a tick ago.
    """

    privileged = True

    def __init__(self, policy: PrivilegedPolicy) -> None:
        """Act by `policy`, on the body that it was trained for."""
        self._policy = policy.eval()
        self.config = policy.config
        self._body = get_body(str(policy.config["body"]))

    def initial_memory(self, batch: int) -> Memory:
        """Return goals of robots without an instruction, elapsed ticks, torques and boxes' places before."""
        return (
            *GoalTracker(batch, cell_size=self._body.cell_size).memory(),
            np.zeros(batch, np.int64),
            np.zeros((batch, self._body.action_size), np.float32),
            np.zeros((batch, 2), np.float32),
        )

    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, U], and the next memory."""
        *followed, elapsed, torque, before = state
        fresh = inputs.terminated | (followed[1] == GoalKind.NONE)
        goals, truth = follow_goals(inputs, tuple(followed), self._body.cell_size)
        elapsed = np.where(fresh, 0, elapsed)
        rows = np.arange(len(fresh))
        box = truth.box_position[rows, goals.box_index]
        speed = np.zeros(truth.box_position.shape[:2], np.float32)
        moved = np.hypot(*(box - before).T) / CONTROL_PERIOD
        # Another box may be in question now; one that is pushed anew is at rest, or nearly so.
        speed[rows, goals.box_index] = np.where(fresh, 0.0, moved)
        view = StoredView(
            self._body, len(rows), goals, inputs.proprio, truth.pose, truth.velocity, truth.box_position, speed,
            cells_of_boxes(truth.box_position, self._body.cell_size), truth.abstract_state[..., WALL] > 0.5,
        )  # fmt: skip
        torque = self._policy.act(privileged_features(view, elapsed / INSTRUCTION_LIMIT, torque))
        return torque, (*goals.memory(), elapsed + 1, torque, box.astype(np.float32))

