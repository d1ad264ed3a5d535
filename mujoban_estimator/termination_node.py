"""The control-termination node: o_cam, o_pr, A_{t-1}, beta_{t-1} -> beta_t.

Run it with `python -m mujoban_estimator.termination_node`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from mujoban_msgs.msg import Episode
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from mujoban_core.interfaces import NO_INSTRUCTION, GroundTruth, Termination, TerminationInput, check_termination
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, described
from mujoban_msgs_py.runtime.module_node import MOST_TICKS, ModuleNode
from mujoban_msgs_py.runtime.tick_node import PATIENCE, Output, run_node

REMEMBERED = 64
"""Instructions kept while it is not known which tick they precede: those of other ticks may come in between."""
_SETTINGS = {
    "sample": described("whether beta is drawn from its probability, as in the paper"),
    "threshold": described("probability above which beta is true where it is not drawn", low=0.0, high=1.0),
    "limit": described("ticks after which beta is forced", low=1, high=MOST_TICKS),
}


class TerminationNode(ModuleNode[Termination]):
    """Publishes `/termination`.

    Parameters, besides those of `ModuleNode`, all settable while it runs:
        sample: Whether beta is sampled from its probability, as in the paper.
        threshold: Probability above which beta is true where it is not sampled.
        limit: Ticks after which beta is forced.
        patience: Offers of a tick until it is classified without the instruction of the tick before. In lockstep that
            instruction exists, and comes; in real time none may have been given. Fixed when the node starts.
    """

    role = "termination"
    inputs = (topics.CAMERA, topics.PROPRIO)
    output = topics.TERMINATION

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Load the module and start listening."""
        super().__init__(**options)
        self._said: dict[int, conversions.InstructionReading] = {}
        for name, descriptor in _SETTINGS.items():
            setattr(self.module, name, self.declare_parameter(name, getattr(self.module, name), descriptor).value)
        check_termination(limit=self.module.limit, threshold=self.module.threshold)
        about = "offers of a tick until it is classified without the instruction before it; few in real time"
        self.patience: int = declare(self, "patience", PATIENCE, described(about, fixed=True, low=0, high=MOST_TICKS))
        listen(self, topics.INSTRUCTION, self._on_instruction)

    def initial_state(self, number: int) -> Any:
        """Return the module's state and beta_{t-1}, [1]."""
        return super().initial_state(number), np.zeros(1, np.bool_)

    def answer(self, stamp: int, episode: Episode, inputs: dict[str, Any], *, insist: bool) -> Sequence[Output] | None:
        """Wait for A_{t-1}, unless this node has not answered the tick before: then it may have missed it."""
        if episode.step == 0:
            # What was said before is of another episode, or of a simulator that ran before this one.
            self._said.clear()
        follows = self.state is not None and episode.step > 0 and self._handled == stamp - topics.TICK
        if follows and not insist and stamp - topics.TICK not in self._said:
            return None
        return super().answer(stamp, episode, inputs, insist=insist)

    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Classify one tick."""
        previous = self._previous(conversions.stamp_of(episode)) if episode.step > 0 else None
        direction = NO_INSTRUCTION if previous is None else previous.direction
        state, terminated = self.state
        beta, state = self.module.step(
            TerminationInput(
                inputs[topics.CAMERA.name][None],
                inputs[topics.PROPRIO.name][None],
                np.array([direction], np.int64),
                terminated,
                truth,
            ),
            state,
        )
        self.state = state, beta.terminated
        value = conversions.termination_value(
            0 if previous is None else previous.sequence,
            beta.probability[0],
            beta.terminated[0],
            beta.timed_out[0],
        )
        return self.say(episode, value, conversions.termination_to_msg)

    def _previous(self, stamp: int) -> conversions.InstructionReading | None:
        """Return the instruction of the tick before a stamp, or the latest that is known."""
        if stamp - topics.TICK in self._said:
            return self._said[stamp - topics.TICK]
        earlier = [s for s in self._said if s < stamp]
        return self._said[max(earlier)] if earlier else None

    def _on_instruction(self, message: Received) -> None:
        self._said[message.stamp] = message.content
        if len(self._said) > REMEMBERED:
            # That of the tick before the next one is waited for, and was said once.
            del self._said[next(stamp for stamp in self._said if stamp != self._handled)]
        self.retry()

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        settings: dict[str, Any] = {name: getattr(self.module, name) for name in _SETTINGS}
        settings |= {p.name: p.value for p in parameters if p.name in _SETTINGS}
        try:
            check_termination(limit=settings["limit"], threshold=settings["threshold"])
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super()._on_parameters(parameters)
        if result.successful:
            for name, value in settings.items():
                setattr(self.module, name, value)
        return result


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(TerminationNode, args)


if __name__ == "__main__":
    leave(main())
