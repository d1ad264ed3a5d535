"""One tick of the modular policy (paper Fig. 1b): sense, terminate, plan, act."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.answers import answering, estimate_and_memory, torque_and_memory
from mujoban_core.bodies import FIRST_PERSON_CAMERA
from mujoban_core.interfaces import (
    NO_INSTRUCTION,
    Controller,
    ControllerInput,
    Estimator,
    EstimatorInput,
    GroundTruth,
    Memory,
    Observation,
    Planner,
    PlannerState,
    Termination,
    TerminationInput,
    TerminationOutput,
    TerminationState,
)
from mujoban_core.trees import map_leaves

_SEEING: Final = ("estimator", "termination", "controller")
"""Roles that look at frames, or at the ground truth in their place; a planner sees estimates alone."""


class PolicyState(NamedTuple):
    """States of the four modules and what they said in the last tick."""

    estimator: Memory
    termination: TerminationState
    planner: PlannerState
    controller: Memory
    terminated: NDArray[np.bool_]
    """beta_{t-1}, [B]."""


class Decision(NamedTuple):
    """What the modules said in one tick; one field per topic of the graph."""

    abstract_state: NDArray[np.float32]
    termination: TerminationOutput
    instruction: NDArray[np.int64]
    sequence: NDArray[np.int64]
    issued: NDArray[np.bool_]
    """Where A_t is a new instruction, [B]."""
    torque: NDArray[np.float32]


@dataclass(frozen=True)
class SensePlanAct:
    """The four modules composed into one policy; the in-process twin of the ROS graph."""

    estimator: Estimator
    termination: Termination
    planner: Planner
    controller: Controller
    told: frozenset[str] = field(init=False)
    """Roles that call themselves privileged: those of them that see get the ground truth, and reports name all.

    Who does so only later gets none, as no report would name it.
    """

    def __post_init__(self) -> None:
        """Settle who gets the ground truth."""
        asked = frozenset(role for role in (*_SEEING, "planner") if getattr(self, role).privileged)
        object.__setattr__(self, "told", asked)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras whose frames a module looks at; oracles go by the ground truth."""
        return () if self.told.issuperset(_SEEING) else (FIRST_PERSON_CAMERA,)

    def initial_state(self, seeds: NDArray[np.int64]) -> PolicyState:
        """Return the state at the start of episodes with the given seeds, [B]."""
        return PolicyState(
            self.estimator.initial_state(seeds),
            self.termination.initial_state(seeds),
            self.planner.initial_state(seeds),
            self.controller.initial_state(seeds),
            np.zeros(len(seeds), np.bool_),
        )

    def robots_looking(self, state: PolicyState) -> None:
        """Return None: the estimator looks in every tick."""

    def step(self, obs: Observation, truth: GroundTruth, state: PolicyState) -> tuple[Decision, PolicyState]:
        """Return the decision of tick t and the next state; `truth` reaches privileged modules only.

        What is seen or estimated each module gets as arrays of its own, which it may write into.

        Raises:
            ValueError: If a module answers by what its role does not have.
            ModuleError: If one has failed.
        """
        with answering("estimator"):
            said = self.estimator.step(
                EstimatorInput(obs.frame.copy(), obs.pose.copy(), self._truth_for("estimator", truth)), state.estimator
            )
            estimate, estimator_state = estimate_and_memory(said, len(obs.pose))
        previous = np.where(state.planner.instruction < 0, NO_INSTRUCTION, state.planner.instruction)
        seen = TerminationInput(
            obs.frame.copy(), obs.proprio.copy(), previous, state.terminated, self._truth_for("termination", truth)
        )
        with answering("termination"):
            beta, termination_state = self.termination.step(seen, state.termination)
        with answering("planner"):
            instruction, planner_state = self.planner.step(estimate.copy(), beta.terminated, state.planner)
        told = ControllerInput(
            instruction, obs.frame.copy(), obs.proprio.copy(), beta.terminated, self._truth_for("controller", truth)
        )
        with answering("controller"):
            said = self.controller.step(told, state.controller)
            torque, controller_state = torque_and_memory(said)
        issued = planner_state.sequence != state.planner.sequence
        decision = Decision(estimate, beta, instruction, planner_state.sequence, issued, torque)
        return decision, PolicyState(
            estimator_state, termination_state, planner_state, controller_state, beta.terminated
        )

    def _truth_for(self, role: str, truth: GroundTruth) -> GroundTruth | None:
        return map_leaves(_copied, truth) if role in self.told else None


def _copied(array: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if array is None else array.copy()
