"""Disturbances that spread recordings over more than the states a good policy visits.

Each wraps a module of the policy and passes on what the policy would do, disturbed with a probability drawn from a
generator that is passed in. A recording that mixes rows of different disturbance covers boxes pushed astray, overshoot,
belated and premature termination, and views to all sides.

Shapes: B robots with U torques each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import BALL, Body
from mujoban_core.grid import AGENT, BOX, TARGET, WALL, Instruction
from mujoban_core.interfaces import (
    Controller,
    ControllerInput,
    Memory,
    Planner,
    Termination,
    TerminationInput,
    put_rows,
    take_rows,
)
from mujoban_core.look_around import LookAroundPlanner
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sokoban.rules import apply

_FOREVER: Final = 1 << 30
_WALK: Final = 25
"""Random instructions in place of a planner that does not know what to do."""
_WITS_END: Final = 4
"""Instructions to stay in a row that show it: a planner that looks around says so once or twice."""
_PERSISTENCE: Final = 0.8
"""Correlation of the torques' noise from one tick to the next."""


@dataclass(frozen=True)
class Disturbance:
    """How much, and how often, recordings depart from the policy; all are probabilities unless they say otherwise."""

    wander: float = 0.3
    """Share of episodes that are random walks."""
    stray: float = 0.05
    """Chance that an instruction is random all the same."""
    infeasible: float = 0.15
    """Chance that a random instruction is drawn from all five, not from those that move the robot."""
    delay: float = 0.4
    """Chance that an instruction's termination is late."""
    max_delay: int = 8
    """Most ticks by which it is late."""
    early: float = 0.001
    """Chance per tick of termination out of the blue."""
    shaky: float = 0.5
    """Share of episodes with noise on the torques."""
    max_noise: float = 0.4
    """Largest standard deviation of that noise, in normalised torque."""
    spin: float = 0.3
    """Share of episodes that begin with a turn on the spot."""
    spin_again: float = 0.002
    """Chance per tick of another turn."""

    @classmethod
    def late_ends(cls) -> Disturbance:
        """Return what has every instruction end late and changes nothing else."""
        return cls(wander=0.0, stray=0.0, delay=1.0, early=0.0, shaky=0.0, spin=0.0, spin_again=0.0)

    def __post_init__(self) -> None:
        """Reject probabilities out of [0, 1]."""
        for name in ("wander", "stray", "infeasible", "delay", "early", "shaky", "max_noise", "spin", "spin_again"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}: expected a number from 0 to 1")
        if self.max_delay < 1:
            raise ValueError(f"max_delay is {self.max_delay}: expected at least 1 tick")


class _DelayMemory(NamedTuple):
    inner: Memory
    wait: NDArray[np.int64]
    """Ticks that termination is still late by, [B]."""


class DisturbedTermination(Termination):
    """Reports completion late or, rarely, too early."""

    def __init__(self, inner: Termination, disturbance: Disturbance, rng: np.random.Generator) -> None:
        """Wrap a termination."""
        super().__init__(limit=inner.limit, sample=inner.sample, threshold=inner.threshold)
        self.privileged = inner.privileged
        self._inner, self._disturbance, self._rng = inner, disturbance, rng

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory of `batch` robots at the start of an episode."""
        return _DelayMemory(self._inner.initial_memory(batch), self._draw(batch))

    def _draw(self, batch: int) -> NDArray[np.int64]:
        late = self._rng.random(batch) < self._disturbance.delay
        return np.where(late, self._rng.integers(1, self._disturbance.max_delay + 1, batch), 0)

    def probability(self, inputs: TerminationInput, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the disturbed probability, [B], and the next memory."""
        inner, wait = memory
        wait = np.where(inputs.terminated, self._draw(len(wait)), wait)
        probability, inner = self._inner.probability(inputs, inner)
        done = probability > self.threshold
        early = self._rng.random(len(wait)) < self._disturbance.early
        disturbed = np.where(early, 1.0, np.where(done & (wait > 0), 0.0, probability)).astype(np.float32)
        return disturbed, _DelayMemory(inner, np.maximum(wait - done, 0))


class DisturbedPlanner(Planner):
    """Follows another planner, except in episodes that are random walks and for stray instructions.

    Memory: that of the other planner; how many more instructions are random, and how often in a row the other planner
    has said to stay, int64 [B] each.
    """

    def __init__(self, inner: Planner, disturbance: Disturbance, rng: np.random.Generator) -> None:
        """Wrap a planner."""
        self.privileged, self.thinks = inner.privileged, inner.thinks
        self._inner, self._disturbance, self._rng = inner, disturbance, rng

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes."""
        wander = self._rng.random(batch) < self._disturbance.wander
        return (*self._inner.initial_memory(batch), np.where(wander, _FOREVER, 0), np.zeros(batch, np.int64))

    def think(self, abstract_state: NDArray[np.float32], memory: Memory) -> Memory:
        """Let the other planner think."""
        return (*self._inner.think(abstract_state, tuple(memory[:-2])), *memory[-2:])

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return instructions, [M], from abstract states [M, N, N, 4]."""
        inner, (wander, stays) = tuple(memory[:-2]), memory[-2:]
        instruction, follow = np.zeros(len(wander), np.int64), np.flatnonzero(wander == 0)
        if follow.size:
            instruction[follow], after = self._inner.decide(abstract_state[follow], take_rows(inner, follow))
            inner = put_rows(inner, follow, after)
        stays = np.where((wander == 0) & (instruction == Instruction.STAY), stays + 1, 0)
        # A planner that is at its wits' end stays: walk on instead, so that the recording goes on showing something.
        wander = np.where(stays == _WITS_END, _WALK, np.maximum(wander - 1, 0))
        stray = self._rng.random(len(wander)) < self._disturbance.stray
        for m in np.flatnonzero(stray | (wander > 0)):
            instruction[m] = self._random(abstract_state[m] > 0.5)
        return instruction, (*inner, wander, stays)

    def _random(self, layers: NDArray[np.bool_]) -> int:
        """Draw an instruction, usually one that moves the robot; `layers` is [N, N, 4]."""
        moves = list(range(len(Instruction)))
        player = np.argwhere(layers[..., AGENT])
        if len(player) == 1 and self._rng.random() >= self._disturbance.infeasible:
            copies = len(Instruction)
            boxes = np.argwhere(layers[..., BOX])
            moved = apply(
                np.repeat(layers[None, ..., WALL], copies, 0),
                np.repeat(layers[None, ..., TARGET], copies, 0),
                np.repeat(boxes[None], copies, 0),
                np.repeat(player, copies, 0),
                np.arange(copies),
            ).moved
            moves = np.flatnonzero(moved).tolist() or moves
        return int(self._rng.choice(moves))


class DisturbedController(Controller):
    """Adds slowly varying noise to another controller's torques, and now and then turns on the spot.

    A body that has no torques for such a turn does not turn.
    """

    def __init__(
        self, inner: Controller, disturbance: Disturbance, rng: np.random.Generator, body: Body = BALL
    ) -> None:
        """Wrap a controller of a body, which has U torques."""
        self.privileged = inner.privileged
        self._inner, self._disturbance, self._rng = inner, disturbance, rng
        turn = np.zeros(body.action_size) if body.turn is None else np.array(body.turn)
        self._left = turn / max(1e-9, np.abs(turn).max())  # as fast as it can
        self._turns_at_all = body.turn is not None

    def initial_memory(self, batch: int) -> Memory:
        """Return the inner memory, noise [B, U], its deviation [B], the turn's torque [B] and ticks left of it [B]."""
        d, rng = self._disturbance, self._rng
        deviation = rng.uniform(0.0, d.max_noise, batch) * (rng.random(batch) < d.shaky)
        turn, left = self._turns(batch, d.spin)
        return (self._inner.initial_memory(batch), np.zeros((batch, len(self._left))), deviation, turn, left)

    def _turns(self, batch: int, chance: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Draw turns to begin with a given chance: torque and duration in ticks, 0 for none."""
        torque = self._rng.uniform(0.3, 1.0, batch) * self._rng.choice([-1.0, 1.0], batch)
        ticks = self._rng.integers(5, 50, batch)
        drawn = (self._rng.random(batch) < chance) & self._turns_at_all
        return torque, np.where(drawn, ticks, 0)

    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return disturbed torques, [B, U], and the next memory."""
        inner, noise, deviation, turn, left = state
        torque, inner = self._inner.step(inputs, inner)
        noise = _PERSISTENCE * noise + np.sqrt(1 - _PERSISTENCE**2) * self._rng.normal(size=noise.shape)
        again, ticks = self._turns(len(left), self._disturbance.spin_again)
        begin = (left == 0) & (ticks > 0)
        turn, left = np.where(begin, again, turn), np.where(begin, ticks, left)
        spinning = turn[:, None] * self._left
        disturbed = np.where((left > 0)[:, None], spinning, torque + deviation[:, None] * noise)
        left = np.maximum(left - 1, 0)
        return np.clip(disturbed, -1.0, 1.0).astype(np.float32), (inner, noise, deviation, turn, left)


def disturbed(
    policy: SensePlanAct, disturbance: Disturbance, rng: np.random.Generator, body: Body = BALL
) -> SensePlanAct:
    """Return a body's policy that does what the given one does, disturbed; where it looks around, it goes on to."""
    planner = policy.planner
    if isinstance(planner, LookAroundPlanner):
        planner = planner.for_planner(DisturbedPlanner(planner.inner, disturbance, rng))
    else:
        planner = DisturbedPlanner(planner, disturbance, rng)
    return SensePlanAct(
        policy.estimator,
        DisturbedTermination(policy.termination, disturbance, rng),
        planner,
        DisturbedController(policy.controller, disturbance, rng, body),
    )
