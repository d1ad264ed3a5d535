"""Look before you push: a turn on the spot at the start of an episode, before the planner's first decision.

Irreversible pushes into the unknown are the first cause of failure under partial observation (paper, section 4). Two
wrappers make any planner and any controller look around first: the planner tells the robot to stay, and the
controller turns on the spot when it is told so. Each counts the ticks of the episode for itself.

Shapes: B robots, M of them with a decision to take, U actuators.
"""

from __future__ import annotations

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_sim.grid import Instruction
from mujoban_sim.interfaces import (
    Controller,
    ControllerInput,
    Memory,
    Module,
    Planner,
    PlannerState,
    put_rows,
    take_rows,
)

LOOK_AROUND_TICKS: Final = 40
"""Ticks in which the ball turns once at `_TURN`; what a learned estimator gets by default."""
_TURN: Final = 0.7
"""Torque of the turn."""
_STEER: Final = 1
"""Actuator that turns the body."""

AnyModule = TypeVar("AnyModule", bound=Module)


class LookAroundPlanner(Planner):
    """Says STAY for the first ticks of an episode, then what another planner says.

    Memory: that of the other planner, and the ticks of the episode, int64 [B].
    """

    def __init__(self, inner: Planner, ticks: int) -> None:
        """Wrap `inner`, whose first decision comes with the first beta after `ticks` ticks."""
        self.inner, self.ticks = inner, ticks
        self.privileged = inner.privileged

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes."""
        return (*self.inner.initial_memory(batch), np.zeros(batch, np.int64))

    def decide(
        self, abstract_state: NDArray[np.float32], memory: Memory
    ) -> tuple[NDArray[np.int64], Memory]:
        """Return STAY where it is still time to look, else the other planner's instruction; [M] and the memory."""
        *others, tick = memory
        inner = tuple(others)
        decision = np.full(len(tick), int(Instruction.STAY), np.int64)
        ready = np.flatnonzero(tick >= self.ticks)
        if ready.size:
            decision[ready], after = self.inner.decide(abstract_state[ready], take_rows(inner, ready))
            inner = put_rows(inner, ready, after)
        return decision, (*inner, tick)

    def step(
        self, abstract_state: NDArray[np.float32], terminated: NDArray[np.bool_], state: PlannerState
    ) -> tuple[NDArray[np.int64], PlannerState]:
        """Return A_t, [B], and count the tick."""
        instruction, state = super().step(abstract_state, terminated, state)
        *inner, tick = state.memory
        return instruction, state._replace(memory=(*inner, tick + 1))


class LookAroundController(Controller):
    """Turns on the spot where the first ticks of an episode ask it to STAY; else does what another controller does.

    Memory: that of the other controller, and the ticks of the episode, int64 [B].
    """

    def __init__(self, inner: Controller, ticks: int) -> None:
        """Wrap `inner`, which acts from tick `ticks` on."""
        self.inner, self.ticks = inner, ticks
        self.privileged = inner.privileged

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes."""
        return (*self.inner.initial_memory(batch), np.zeros(batch, np.int64))

    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, U], and the next memory; the other controller sees every tick."""
        *inner, tick = state
        torque, after = self.inner.step(inputs, tuple(inner))
        looking = (tick < self.ticks) & (inputs.instruction == int(Instruction.STAY))
        turn = np.zeros_like(torque)
        turn[:, _STEER] = _TURN
        return np.where(looking[:, None], turn, torque), (*after, tick + 1)


def look_around(module: AnyModule, ticks: int) -> AnyModule | LookAroundPlanner | LookAroundController:
    """Return a module that looks around for the first ticks of each episode; estimators do so anyway.

    Raises:
        ValueError: If `ticks` is negative.
    """
    if ticks < 0:
        raise ValueError(f"look_around {ticks}: expected a number of ticks, 0 for none")
    if ticks and isinstance(module, Planner):
        return LookAroundPlanner(module, ticks)
    if ticks and isinstance(module, Controller):
        return LookAroundController(module, ticks)
    return module
