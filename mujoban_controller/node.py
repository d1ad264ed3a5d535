"""The controller's node: A, o_cam, o_pr, beta -> a_tau (`python -m mujoban_controller.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from typing import Any

import numpy as np
from mujoban_msgs.msg import Episode

from mujoban_core.answers import check_torques, torque_and_memory
from mujoban_core.interfaces import Controller, ControllerInput, GroundTruth
from mujoban_core.signals import leave
from mujoban_msgs_py import topics
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.tick_node import Output, run_node


class ControllerNode(ModuleNode[Controller]):
    """Publishes `/torque`; parameters as in `ModuleNode`."""

    role = "controller"
    inputs = (topics.INSTRUCTION, topics.CAMERA, topics.PROPRIO, topics.TERMINATION)
    output = topics.TORQUE

    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Act for one tick."""
        said = self.module.step(
            ControllerInput(
                np.array([inputs[topics.INSTRUCTION.name].direction], np.int64),
                inputs[topics.CAMERA.name][None],
                inputs[topics.PROPRIO.name][None],
                np.array([inputs[topics.TERMINATION.name].terminated]),
                truth,
            ),
            self.state,
        )
        torque, self.state = torque_and_memory(said)
        if self.driven is not None:
            check_torques(torque, (1, self.driven.action_size))
        return self.say_torque(episode, torque[0])


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(ControllerNode, args)


if __name__ == "__main__":
    leave(main())
