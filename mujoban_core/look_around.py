"""Look before you push: turns on the spot, and walks to where more can be seen, while the map is uncertain.

Irreversible pushes into the unknown are the first cause of failure under partial observation (paper, section 4). Two
wrappers make any planner and any controller look around: the planner tells the robot to stay where it wants a look, or
to walk to such a place, and the controller turns on the spot when it is told to stay again after it has stayed: first
the robot comes to rest in the middle of its cell, which after a push it is not in. Neither pushes a box for it. A body
that no single action turns has a controller that has learned to turn when it is told to stay, and needs the first
alone.

Shapes: B robots, M of them with a decision to take, N = `grid.GRID_SIZE`, U actuators.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import BALL, Body
from mujoban_core.grid import GRID_SIZE, Instruction
from mujoban_core.interfaces import (
    Controller,
    ControllerInput,
    Memory,
    Module,
    Planner,
    PlannerState,
    put_rows,
    take_rows,
)
from mujoban_core.viewpoints import step_to_view, turn_view, walk_view

LOOKING_ROLES: Final = ("planner", "controller")
"""The roles that `look_around` wraps."""
WALKS: Final = 30
"""Instructions that an episode spends at most on looks after the first and on the way there, by default."""
_COMING_TO_REST: Final = -1
"""In the place of the tick at which a look ends: it begins when the robot has stayed."""
_AT_REST: Final = 10
"""Ticks for which a robot turns after it was told that it has stayed; then it may have left the middle of its cell."""
_OWN: Final = 5
"""Parts of the memory that are the wrapper's own."""

AnyModule = TypeVar("AnyModule", bound=Module)


class Scout(ABC):
    """Says where to look before pushing."""

    @abstractmethod
    def step(self, abstract_state: NDArray[np.float32], shown: NDArray[np.bool_]) -> Instruction | None:
        """Return the next step to where more can be seen; STAY to turn here, None if nothing more is to be seen.

        Args:
            abstract_state: Estimate, [N, N, 4].
            shown: Cells that have been in view, [N, N]: what that has not made certain will not become so by looking.
        """


class ScriptedScout(Scout):
    """Walks to where a turn shows most that is unknown, by a rule."""

    def __init__(self, body: Body = BALL) -> None:
        """Say where the camera of a body sees most."""
        self.body = body

    def step(self, abstract_state: NDArray[np.float32], shown: NDArray[np.bool_]) -> Instruction | None:
        """Return the first step of the way there, STAY if it is here, None if no place is worth the way."""
        return step_to_view(abstract_state, shown, self.body)


class LookAroundPlanner(Planner):
    """Looks around first, and wherever there is something to be seen; else says what another planner says.

    Memory: that of the other planner; the tick of the episode and that at which the present look ends (0: none, -1: it
    begins when the robot has come to rest), int64 [B]; the instructions left for looking, int64 [B]; the cells that
    have been in view, by where the robot was and which way it walked, bool [B, N, N]; what it was told last, int64 [B].
    """

    def __init__(
        self, inner: Planner, ticks: int, walks: int = WALKS, scout: Scout | None = None, body: Body = BALL
    ) -> None:
        """Wrap a planner.

        Args:
            inner: The planner.
            ticks: Of a look.
            walks: Instructions that looks after the first and the way there take at most.
            scout: Says where to look; by default by a rule.
            body: Carries the camera.
        """
        self.inner, self.ticks, self.walks, self.body = inner, ticks, walks, body
        self.scout = scout or ScriptedScout(body)
        self.privileged = inner.privileged
        self.thinks = inner.thinks

    def for_planner(self, inner: Planner) -> LookAroundPlanner:
        """Return what makes another planner look around like this one."""
        return LookAroundPlanner(inner, self.ticks, self.walks, self.scout, self.body)

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes, each of which begins with a look."""
        tick, until = np.zeros(batch, np.int64), np.full(batch, self.ticks)
        seen = np.zeros((batch, GRID_SIZE, GRID_SIZE), np.bool_)
        told = np.full(batch, int(Instruction.STAY))
        return (*self.inner.initial_memory(batch), tick, until, np.full(batch, self.walks), seen, told)

    def decide(
        self, abstract_state: NDArray[np.float32], memory: Memory
    ) -> tuple[NDArray[np.int64], Memory]:
        """Return STAY for a look, a step towards one, or the other planner's instruction, [M], and the memory."""
        inner, (tick, until, walks, seen, told) = tuple(memory[:-_OWN]), memory[-_OWN:]
        until, walks, seen = until.copy(), walks.copy(), seen.copy()
        decision = np.full(len(tick), int(Instruction.STAY), np.int64)
        ready = np.zeros(len(tick), np.bool_)
        for i in np.flatnonzero(tick >= until):
            if until[i] == _COMING_TO_REST:
                until[i] = tick[i] + self.ticks
                continue
            # What was in view and is not certain will not become so from here.
            if until[i] > 0:  # A look has just ended
                seen[i] |= turn_view(abstract_state[i], self.body)
                until[i] = 0
            elif told[i] != Instruction.STAY:
                seen[i] |= walk_view(abstract_state[i], Instruction(told[i]), self.body)
            # Copies: what a scout writes changes nothing that the planner goes by, and no other robot's is behind them.
            step = None if walks[i] == 0 else self.scout.step(abstract_state[i].copy(), seen[i].copy())
            if step is None:
                ready[i] = True
                continue
            walks[i] -= 1
            decision[i] = step
            if step == Instruction.STAY:
                until[i] = _COMING_TO_REST
        rows = np.flatnonzero(ready)
        if rows.size:
            decision[rows], after = self.inner.decide(abstract_state[rows], take_rows(inner, rows))
            inner = put_rows(inner, rows, after)
        return decision, (*inner, tick, until, walks, seen, decision.copy())

    def think(self, abstract_state: NDArray[np.float32], memory: Memory) -> Memory:
        """Let the other planner think."""
        return (*self.inner.think(abstract_state, tuple(memory[:-_OWN])), *memory[-_OWN:])

    def step(
        self, abstract_state: NDArray[np.float32], terminated: NDArray[np.bool_], state: PlannerState
    ) -> tuple[NDArray[np.int64], PlannerState]:
        """Return A_t, [B], and count the tick."""
        instruction, state = super().step(abstract_state, terminated, state)
        *others, tick, until, walks, seen, told = state.memory
        return instruction, state._replace(memory=(*others, tick + 1, until, walks, seen, told))


class LookAroundController(Controller):
    """Turns on the spot where the robot is to STAY and has just stayed; else does what another controller does.

    Memory: that of the other controller; whether the robot was told to STAY, bool [B]; ticks for which it turns, this
    one included, unless it is told that it has stayed again, int64 [B].
    """

    def __init__(self, inner: Controller, turn: Sequence[float]) -> None:
        """Wrap `inner`; `turn` is the action, U values, that turns the robot on the spot."""
        self.inner = inner
        self.privileged = inner.privileged
        self._turn = np.array(turn, np.float32)

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes."""
        return (*self.inner.initial_memory(batch), np.zeros(batch, np.bool_), np.zeros(batch, np.int64))

    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, U], and the next memory; the other controller sees every tick."""
        inner, (stayed, turns) = tuple(state[:-2]), state[-2:]
        torque, memory = self.inner.step(inputs, inner)
        stays = inputs.instruction == int(Instruction.STAY)
        turns = np.where(stayed & inputs.terminated, _AT_REST, np.maximum(turns - 1, 0)) * stays
        return np.where(turns[:, None] > 0, self._turn, torque), (*memory, stays, turns)


def look_around(
    module: AnyModule, ticks: int, scout: Scout | None = None, body: Body = BALL
) -> AnyModule | LookAroundPlanner | LookAroundController:
    """Return a planner or controller that looks around, `ticks` a look; 0, or another module: itself.

    So is the controller of a body that no single action turns: whether it turns is for it to learn.

    Raises:
        ValueError: If `ticks` is negative.
    """
    if ticks < 0:
        raise ValueError(f"look_around {ticks}: expected a number of ticks, 0 for none")
    if ticks == 0:
        return module
    if isinstance(module, Planner):
        by_rule = scout is None or isinstance(scout, ScriptedScout)
        return LookAroundPlanner(module, ticks, scout=ScriptedScout(body) if by_rule else scout, body=body)
    if isinstance(module, Controller) and body.turn is not None:
        return LookAroundController(module, body.turn)
    return module
