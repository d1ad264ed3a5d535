"""The state estimator's node: o_cam, o_pos -> estimate of s_abst (`python -m mujoban_estimator.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from typing import Any

from mujoban_msgs.msg import Episode

from mujoban_core.answers import estimate_and_memory
from mujoban_core.interfaces import Estimator, EstimatorInput, GroundTruth
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.tick_node import Output, run_node


class EstimatorNode(ModuleNode[Estimator]):
    """Publishes `/abstract_state`; parameters as in `ModuleNode`."""

    role = "estimator"
    inputs = (topics.CAMERA, topics.POSE)
    output = topics.ABSTRACT_STATE

    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Estimate the abstract state of one tick."""
        frame, pose = inputs[topics.CAMERA.name], inputs[topics.POSE.name]
        said = self.module.step(EstimatorInput(frame[None], pose[None], truth), self.state)
        estimate, self.state = estimate_and_memory(said, 1)
        return self.say(episode, conversions.abstract_state_value(estimate[0]), conversions.abstract_state_to_msg)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(EstimatorNode, args)


if __name__ == "__main__":
    leave(main())
