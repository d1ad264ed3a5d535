"""Instructions as a planner gives them, and terminations as a classifier gives them, for training the controller.

Random instructions alone miss what matters: long pushes, recentring after a push, lanes along walls. So some
rows follow a planner's solution of their level, with a random instruction thrown in now and then.

Shapes: B robots, M selected rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import INSTRUCTION_LIMIT, Instruction
from mujoban_core.ranges import check_counts, check_not_negative, check_shares
from mujoban_sim.goals import GoalKind, GoalTracker
from mujoban_sim.world import World

_HEADINGS = [i for i in Instruction if i != Instruction.STAY]


@dataclass(frozen=True)
class InstructionConfig:
    """Distribution of random instructions; the rest are moves."""

    stay: float = 0.05
    """Share of stay."""
    stays_on: float = 0.985
    """Chance that a stay is followed by another, as in a look around, for a body that learns to turn."""
    infeasible: float = 0.05
    """Share of instructions towards walls and blocked boxes, where there are any."""
    push: float = 0.5
    """Share of pushes among the others, where there are any."""
    repeat: float = 0.4
    """Chance that a push goes on in the same direction, where it can."""

    def __post_init__(self) -> None:
        """Reject what is no share."""
        check_shares(self, "stay", "stays_on", "infeasible", "push", "repeat")


def feasible_kinds(world: World) -> NDArray[np.int64]:
    """Return the `GoalKind` that each instruction would have if it were issued now, [B, 5]."""
    scratch = GoalTracker(world.batch, cell_size=world.body.cell_size)
    rows = np.arange(world.batch)
    kinds = np.empty((world.batch, len(Instruction)), np.int64)
    for instruction in Instruction:
        scratch.reached[:], scratch.goal_cell[:] = world.goals.reached, world.goals.goal_cell
        direction = np.full(world.batch, instruction, np.int64)
        scratch.begin(rows, direction, world.wall, world.agent_cell, world.box_cell)
        kinds[:, instruction] = scratch.kind
    return kinds


def random_instruction(
    kinds: NDArray[np.int64], previous: int, config: InstructionConfig, rng: np.random.Generator
) -> int:
    """Draw an instruction.

    Args:
        kinds: Kind of each instruction, [5].
        previous: Instruction before.
        config: Distribution.
        rng: Source of randomness.
    """
    options = {kind: [i for i in _HEADINGS if kinds[i] == kind] for kind in GoalKind}
    moves, pushes, holds = options[GoalKind.MOVE], options[GoalKind.PUSH], options[GoalKind.HOLD]
    draw = rng.random()
    if draw < config.stay or not (moves or pushes):
        return int(Instruction.STAY)
    if holds and draw < config.stay + config.infeasible:
        return int(rng.choice(holds))
    if previous in pushes and rng.random() < config.repeat:
        return previous
    if pushes and (not moves or rng.random() < config.push):
        return int(rng.choice(pushes))
    return int(rng.choice(moves))


@dataclass(frozen=True)
class TerminationConfig:
    """How termination signals differ from the rule of paper C.4."""

    late: float = 0.1
    """Share of instructions whose signal comes late."""
    delay: float = 5.0
    """Mean number of ticks by which it does; until then the robot has to hold."""
    early: float = 0.08
    """Share of instructions whose signal comes early."""
    reach: float = 0.25
    """An early signal comes within up to this distance, in cells, beyond the tolerance."""
    limit: int = INSTRUCTION_LIMIT
    """Ticks after which a signal is forced."""

    def __post_init__(self) -> None:
        """Reject what is no share or no time."""
        check_shares(self, "late", "early")
        check_not_negative(self, "delay", "reach")
        check_counts(self, "limit")


EXACT = TerminationConfig(late=0.0, early=0.0)
"""Signals by the rule, as of the oracle."""


class TerminationNoise:
    """Termination signals of B robots: the completion rule, early or late at times."""

    def __init__(self, batch: int, config: TerminationConfig, rng: np.random.Generator) -> None:
        """Draw from `rng`."""
        self._config, self._rng = config, rng
        self._delay = np.zeros(batch, np.int64)
        self._margin = np.zeros(batch)
        self._completed = np.zeros(batch, np.int64)
        self.elapsed = np.zeros(batch, np.int64)
        """Ticks since the instruction in force was issued, [B]."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that change, by name; they are live."""
        return {"delay": self._delay, "margin": self._margin, "completed": self._completed, "elapsed": self.elapsed}

    def issue(self, rows: NDArray[np.int64]) -> None:
        """Draw how the signals for new instructions in the given rows, [M], will come."""
        config, rng, m = self._config, self._rng, len(rows)
        draw = rng.random(m)
        late = draw < config.late
        early = ~late & (draw < config.late + config.early)
        self._delay[rows] = np.where(late, rng.geometric(1.0 / max(config.delay, 1.0), m), 0)
        self._margin[rows] = np.where(early, rng.uniform(0.0, config.reach, m), 0.0)
        self._completed[rows] = 0
        self.elapsed[rows] = 0

    def step(self, completed: NDArray[np.bool_], distance: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return the signal after one tick, [B].

        Args:
            completed: The rule's verdict, [B].
            distance: Distance in cells, beyond the tolerance, of what has to reach its target, [B].
        """
        self.elapsed += 1
        self._completed += completed
        early = (self._margin > 0) & (distance < self._margin)
        return early | (completed & (self._completed > self._delay)) | (self.elapsed >= self._config.limit)
