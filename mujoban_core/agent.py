"""An agent that plays alone, without the four modules: from what it sees to torques in one step (paper appendix D).

Subclass `Agent`, say in `sees` what it receives, and implement `step`; every program that plays the stack then plays it
with `--agent package.module:Class`. It is found as modules are, by entry points named `agent.NAME` of the group
`mujoban.modules`.

Shapes: B robots, N = `grid.GRID_SIZE`, P proprioceptive values, U actuators.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import FIRST_PERSON_CAMERA
from mujoban_core.camera import TOP_DOWN_CAMERA
from mujoban_core.grid import CHANNELS
from mujoban_core.interfaces import (
    NO_INSTRUCTION,
    GroundTruth,
    Memory,
    Module,
    Observation,
    TerminationOutput,
)
from mujoban_core.sense_plan_act import Decision


class AgentInput(NamedTuple):
    """What an agent sees in one tick; None where it does not ask for it."""

    frame: NDArray[np.uint8] | None = None
    """o_cam, RGB [B, 64, 64, 3]."""
    proprio: NDArray[np.float32] | None = None
    """o_pr, [B, P]."""
    pose: NDArray[np.float32] | None = None
    """o_pos = (x [m], y [m], psi [rad]) in the map frame, [B, 3]."""
    top_down: NDArray[np.uint8] | None = None
    """o_top, north up, RGB [B, 64, 64, 3]; privileged."""
    abstract_state: NDArray[np.float32] | None = None
    """s_abst, binary, [B, N, N, 4]; privileged."""


OWN_SENSES: Final = ("frame", "proprio", "pose")
"""What the robot itself perceives (paper appendix B)."""


def beyond_senses(sees: Iterable[str]) -> bool:
    """Tell whether what is seen is more than the robot itself perceives."""
    return not set(sees) <= set(OWN_SENSES)


class Agent(Module):
    """(o_cam, o_pr, o_pos), or more, -> motor torques."""

    sees: tuple[str, ...] = OWN_SENSES
    """Fields of `AgentInput` that it receives."""

    @property
    def privileged(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether it sees what the robot itself cannot perceive."""
        return beyond_senses(self.sees)

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the state at the start of episodes with the given seeds of random streams, [B]."""
        return self.initial_memory(len(seeds))

    def robots_looking(self, state: Memory) -> NDArray[np.bool_] | None:
        """Return which robots look in the coming tick, [B]; the frames of others may be black. None: all do."""
        return None

    @abstractmethod
    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques normalised to [-1, 1], [B, U], and the next state."""


def agent_input(sees: tuple[str, ...], observation: Observation, truth: GroundTruth | None) -> AgentInput:
    """Return what an agent that sees so much receives.

    Raises:
        ValueError: If there is no such sight, or what is privileged is missing.
    """
    known = {"top_down": None, "abstract_state": None} if truth is None else truth._asdict()
    known |= observation._asdict()
    for name in sees:
        if name not in AgentInput._fields:
            raise ValueError(f"the agent sees {name!r}: expected some of {', '.join(AgentInput._fields)}")
        if known[name] is None:
            raise ValueError(f"the agent sees {name}, which is missing: expected the simulator's")
    return AgentInput(**{name: known[name] for name in sees})


@dataclass(frozen=True)
class AgentPolicy:
    """An agent in the place of `SensePlanAct`: all that it says of a tick are its torques."""

    agent: Agent
    sees: tuple[str, ...] = field(init=False)
    """What it sees; what it asks for only later it does not get, as no report would name it."""
    privileged: bool = field(init=False)

    def __post_init__(self) -> None:
        """Settle what it sees."""
        object.__setattr__(self, "sees", tuple(self.agent.sees))
        # By what it is shown: an agent's own word on it may be false.
        object.__setattr__(self, "privileged", beyond_senses(self.sees))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras whose frames it looks at."""
        views = {"frame": FIRST_PERSON_CAMERA, "top_down": TOP_DOWN_CAMERA}
        return tuple(camera for name, camera in views.items() if name in self.sees)

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the state at the start of episodes with the given seeds, [B]."""
        return self.agent.initial_state(seeds)

    def robots_looking(self, state: Memory) -> NDArray[np.bool_] | None:
        """Return which robots look in the coming tick, [B]; None: all do."""
        return self.agent.robots_looking(state)

    def step(self, obs: Observation, truth: GroundTruth, state: Memory) -> tuple[Decision, Memory]:
        """Return the decision of a tick, in which no instruction is issued, and the next state."""
        inputs = agent_input(self.sees, obs, truth if self.privileged else None)
        torque, state = self.agent.step(inputs, state)
        b = len(torque)
        never, nothing = np.zeros(b, np.bool_), np.zeros(b, np.int64)
        silent = TerminationOutput(np.zeros(b, np.float32), never, never)
        estimate = np.zeros((b, 0, 0, len(CHANNELS)), np.float32)
        return Decision(estimate, silent, nothing + NO_INSTRUCTION, nothing, never, torque), state
