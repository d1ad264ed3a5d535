"""The node of an agent that plays alone: o_cam, o_pr, o_pos, or more, -> a_tau (`python -m mujoban_baselines.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from typing import Any, Final, Unpack

from mujoban_msgs.msg import Episode

from mujoban_core.agent import OWN_SENSES, Agent, AgentInput, beyond_senses
from mujoban_core.interfaces import GroundTruth, Module
from mujoban_core.plugins import AGENT
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.descriptors import NodeOptions
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.tick_node import Input, Output, run_node

_SIGHTS: Final = {
    "frame": Input(topics.CAMERA, conversions.frame_from_msg),
    "proprio": Input(topics.PROPRIO, conversions.body_proprio_from_msg),
    "pose": Input(topics.POSE, conversions.pose_from_msg),
    "top_down": Input(topics.TOP_CAMERA, conversions.frame_from_msg),
    "abstract_state": Input(topics.TRUE_ABSTRACT_STATE, conversions.abstract_state_from_msg),
}
"""Where what an agent sees comes from."""


class AgentNode(ModuleNode[Agent]):
    """Publishes `/torque` in the place of the controller; the simulator's `instructed` has to be false.

    Parameters as in `ModuleNode`. What the robot itself perceives is read in any case, what is privileged where the
    agent asks for it.
    """

    role = AGENT
    truth_inputs = ()
    output = topics.TORQUE

    @property
    def inputs(self) -> Sequence[Input]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What is read in every tick."""
        return [_SIGHTS[name] for name in dict.fromkeys((*OWN_SENSES, *self._sees))]

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Load the agent and start listening."""
        self._sees: tuple[str, ...] = ()
        super().__init__(**options)

    def prepare(self, module: Module) -> Module:
        """Return the agent, unless it sees something else than the one before."""
        assert isinstance(module, Agent)  # `load_module` has checked it
        # Asked once: what an agent says that it sees may change.
        sees, before = tuple(module.sees), self._sees
        if before and sees != before:
            raise ValueError(f"the agent sees {', '.join(sees)}: expected {', '.join(before)}, as before")
        self._sees = sees
        return module

    def asks(self, module: Module) -> bool:
        """Tell whether it sees more than the robot perceives, whatever it says itself."""
        return beyond_senses(self._sees)

    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Act for one tick."""
        seen = {name: inputs[_SIGHTS[name].topic.name][None] for name in self._sees}
        torque, self.state = self.module.step(AgentInput(**seen), self.state)
        return self.say(episode, conversions.torque_value(torque[0]), conversions.torque_to_msg)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(AgentNode, args)


if __name__ == "__main__":
    leave(main())
