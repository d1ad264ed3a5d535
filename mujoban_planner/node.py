"""The planner's node: estimate of s_abst, beta -> A (`python -m mujoban_planner.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from mujoban_msgs.msg import Episode

from mujoban_core.interfaces import GroundTruth, Module, Planner
from mujoban_core.look_around import Scout
from mujoban_core.plugins import SCRIPTED, load_scout
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, described
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.tick_node import Output, run_node
from mujoban_planner.deliberation import (
    CERTAINTY,
    MOST_EVALUATIONS,
    MOST_SECONDS,
    MOST_THINKING,
    PER_TICK,
    Deliberation,
)


class PlannerNode(ModuleNode[Planner]):
    """Publishes `/instruction` in every tick.

    Parameters, beside those of `ModuleNode`:
        thinking: Thinking time of the network, 0 for its own. Fixed when the node starts.
        look_ahead: Network evaluations of a tree search that looks for a way to the end of the level, spread over the
            ticks; 0 for none, -1 for 400 by the learned planner and none by any other. Fixed likewise.
        look_ahead_per_tick: Of them, in one tick. Fixed likewise.
        look_ahead_certainty: Probability with which all must be as it seems that a plan rests on. Fixed likewise.
        look_ahead_deadline: Seconds of a tick in which it searches, in the place of `look_ahead_per_tick`; 0 for none,
            as in lockstep. Fixed likewise.
        scout: What says where to look before pushing: scripted, learned or package.module:Class. Fixed likewise.
        scout_weights: Weights file of the learned one, which needs it: none ships. Fixed likewise.
    """

    role = "planner"
    inputs = (topics.ABSTRACT_STATE, topics.TERMINATION)
    output = topics.INSTRUCTION
    truth_inputs = ()
    """A planner, also the oracle, goes by the abstract state that it is given."""

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Load the module and start listening."""
        self._deliberation: Deliberation | None = None
        self._scout: Scout | None = None
        super().__init__(**options)

    def prepare(self, module: Module) -> Module:
        """Let the planner think as long as it is to."""
        if self._deliberation is None:
            self._deliberation = self._declare_deliberation()
        return self._deliberation.prepare(module, self._source)

    def _declare_deliberation(self) -> Deliberation:
        def number(name: str, default: int, about: str, low: int, high: int) -> int:
            return declare(self, name, default, described(about, fixed=True, low=low, high=high))

        certain = described("probability of what a plan rests on", fixed=True, low=0.0, high=1.0)
        time = described("seconds of a tick for it instead; 0: by number", fixed=True, low=0.0, high=MOST_SECONDS)
        thinking = number("thinking", 0, "thinking time of the network; 0: its own", 0, MOST_THINKING)
        ahead = number("look_ahead", -1, "evaluations of a search ahead; 0: none, -1: its own", -1, MOST_EVALUATIONS)
        return Deliberation(
            thinking,
            None if ahead < 0 else ahead,
            number("look_ahead_per_tick", PER_TICK, "evaluations in a tick", 1, MOST_EVALUATIONS),
            declare(self, "look_ahead_certainty", CERTAINTY, certain),
            declare(self, "look_ahead_deadline", 0.0, time),
        )

    @property
    def scout(self) -> Scout:
        """What says where to look."""
        if self._scout is None:
            which = described("scripted, learned or package.module:Class", fixed=True)
            source = declare(self, "scout", SCRIPTED, which)
            file = described("weights file of the learned scout, which needs it", fixed=True)
            weights = declare(self, "scout_weights", "", file)
            self._scout = load_scout(source, Path(weights) if weights else None, body=self._body or None)
        return self._scout

    def begin(self, episode: Episode, inputs: dict[str, Any]) -> None:
        """Start the state; a planner that joins an episode goes on with the numbers of its predecessor."""
        super().begin(episode, inputs)
        issued = inputs[topics.TERMINATION.name].sequence
        if episode.step > 0:
            self.state = self.state._replace(sequence=np.array([issued], np.int64))

    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Hold the instruction in force or decide on a new one."""
        terminated = np.array([inputs[topics.TERMINATION.name].terminated])
        instruction, self.state = self.module.step(inputs[topics.ABSTRACT_STATE.name][None], terminated, self.state)
        value = conversions.instruction_value(self.state.sequence[0], instruction[0])
        return self.say(episode, value, conversions.instruction_to_msg)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(PlannerNode, args)


if __name__ == "__main__":
    leave(main())
