"""The node of an agent that plays alone: o_cam, o_pr, o_pos, or more, -> a_tau (`python -m mujoban_baselines.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from typing import Any, Final, Unpack

from mujoban_msgs.msg import Episode

from mujoban_core.agent import OWN_SENSES, Agent, AgentInput, beyond_senses
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.interfaces import GroundTruth, Module
from mujoban_core.plugins import AGENT
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.descriptors import NodeOptions
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.tick_node import Output, run_node
from mujoban_msgs_py.topics import Topic

_SIGHTS: Final = {
    "frame": topics.CAMERA,
    "proprio": topics.PROPRIO,
    "pose": topics.POSE,
    "top_down": topics.TOP_CAMERA,
    "abstract_state": topics.TRUE_ABSTRACT_STATE,
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
    def inputs(self) -> Sequence[Topic]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What is read in every tick."""
        return [_SIGHTS[name] for name in dict.fromkeys((*OWN_SENSES, *self._sees))]

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Load the agent and start listening."""
        self._sees: tuple[str, ...] = ()
        super().__init__(**options)

    def check(self, topic: Topic, item: Any) -> None:
        """Refuse also a view from above of another size than agents see."""
        super().check(topic, item)
        if topic is topics.TOP_CAMERA and item.shape != (FRAME_SIZE, FRAME_SIZE, 3):
            said = f"o_top must have shape [{FRAME_SIZE}, {FRAME_SIZE}, 3], got {[*item.shape]}"
            raise conversions.ConversionError(said)

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
        seen = {name: inputs[_SIGHTS[name].name][None] for name in self._sees}
        torque, self.state = self.module.step(AgentInput(**seen), self.state)
        return self.say_torque(episode, torque[0])


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(AgentNode, args)


if __name__ == "__main__":
    leave(main())
