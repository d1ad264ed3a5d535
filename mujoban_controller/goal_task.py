"""The goal task in which the controller learns (paper C.3), over the vectorised world.

The robot gets instructions, random or from a planner, and +4 for each that it completes, -5 for each that it
does not complete within 120 steps, and a small penalty while it moves backwards. Boxes that leave the
middle of their lanes cost something as well, since they jam at pegs later. An instruction that ends is followed
by the next: the return bootstraps through it, except where one failed.

Shapes: B robots, M selected rows, P proprioceptive values, U actuators.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.goal_features import drift, goal_offsets
from mujoban_controller.instructions import (
    EXACT,
    InstructionConfig,
    TerminationConfig,
    TerminationNoise,
    feasible_kinds,
    random_instruction,
)
from mujoban_core.grid import COMPLETION_TOLERANCE, DIFFICULTIES, INSTRUCTION_LIMIT, Instruction
from mujoban_core.interfaces import ControllerInput, Planner, put_rows, take_rows
from mujoban_sim.driving import forward_speed
from mujoban_sim.goals import GoalKind
from mujoban_sim.presets import DEFAULT_WORLD, get_world
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import LevelError

EpisodeSource = Callable[[], EpisodeSpec]
"""Yields the next episode to play."""
_BACKWARDS = -0.05
"""Speed in cells per second below which a robot counts as moving backwards."""
_REMEMBERED = 256
"""Failures that are kept to be tried again."""


@dataclass(frozen=True)
class GoalTaskConfig:
    """Settings of the goal task."""

    batch: int = 64
    """B, robots."""
    body: str = "ball"
    world: str = DEFAULT_WORLD
    """The physical world: reference or eased."""
    difficulty: int = 5
    tolerance: float = 0.08
    """Completion tolerance in cells; tighter than the paper's 0.1, so that evaluation leaves a margin."""
    planned: float = 0.6
    """Share of episodes that follow the planner."""
    astray: float = 0.06
    """Chance that a random instruction takes the place of a planned one."""
    horizon: float = 200.0
    """Mean steps of an episode, exponentially distributed. Short ones show more levels and appearances, without
    which a camera policy knows the 64 warehouses that it is in by heart; `inf` goes on until the level is solved."""
    retry: float = 0.0
    """Share of episodes that begin where a feasible instruction failed before, in the same appearance. Failures get
    rare long before they are few enough, and the same one then comes again and again in the level that has it."""
    patience: int = 3
    """Instructions that fail in a row before the episode is given up, since a jammed box stays jammed."""
    misaligned: float = 0.5
    """Share of episodes that begin with robot and boxes off the centres of their cells."""
    robot_offset: float = 0.25
    box_offset: float = 0.1
    """Largest such offsets in cells; boxes move along one axis only, across it by less than half of that."""
    completed_reward: float = 4.0
    failed_reward: float = -5.0
    backwards_penalty: float = 0.02
    """Cost of a step in which the robot moves backwards. Tiny: after a push it has to back up before it turns."""
    drift_penalty: float = 10.0
    """Cost of each cell by which boxes leave the middle of their lanes."""
    instructions: InstructionConfig = field(default_factory=InstructionConfig)
    terminations: TerminationConfig = field(default_factory=TerminationConfig)

    def __post_init__(self) -> None:
        """Reject settings that contradict each other."""
        get_world(self.world)
        if not self.horizon > 0:
            raise ValueError(f"horizon {self.horizon}: expected a positive number of steps")
        if not 0.0 <= self.retry <= 1.0:
            raise ValueError(f"retry {self.retry}: expected a share between 0 and 1")
        if self.difficulty not in DIFFICULTIES:
            raise ValueError(f"difficulty {self.difficulty}: expected one of {sorted(DIFFICULTIES)}")
        if not 0.0 < self.tolerance <= COMPLETION_TOLERANCE:
            raise ValueError(f"tolerance {self.tolerance}: expected at most the evaluation's {COMPLETION_TOLERANCE}")


def judging_config(
    batch: int, body: str = "ball", difficulty: int = 5, *, world: str = DEFAULT_WORLD, plans: bool = True
) -> GoalTaskConfig:
    """Return the settings under which controllers are judged: exact signals and the planner's instructions.

    Without `plans` they are random ones of every kind, and an episode ends after 1,000 steps on average.
    """
    return GoalTaskConfig(
        batch=batch,
        body=body,
        world=world,
        difficulty=difficulty,
        tolerance=COMPLETION_TOLERANCE,
        planned=float(plans),
        astray=0.0,
        horizon=math.inf if plans else 1000.0,
        misaligned=0.0,
        patience=12,
        instructions=InstructionConfig(stay=0.1, infeasible=0.2),
        terminations=EXACT,
    )


class Outcome(NamedTuple):
    """How an instruction ended."""

    row: int
    kind: GoalKind
    direction: Instruction
    completed: bool
    ticks: int
    off_lane: bool
    """Whether the pushed box stands across its lane by more than the tolerance."""
    wrong_cell: bool
    """Whether robot or boxes are in cells to which the instruction does not lead."""


class EpisodeEnd(NamedTuple):
    """How an episode ended."""

    row: int
    seed: int
    solved: bool
    episode_return: float
    steps: int


class TaskStep(NamedTuple):
    """Result of `GoalTask.step`."""

    reward: NDArray[np.float32]
    """[B]."""
    discount: NDArray[np.float32]
    """0 where an instruction failed or the episode ended, else 1, [B]."""
    outcomes: list[Outcome]
    """Instructions that ended."""
    episodes: list[EpisodeEnd]
    """Episodes that ended."""


def goal_reward(
    config: GoalTaskConfig,
    completed: NDArray[np.bool_],
    failed: NDArray[np.bool_],
    drifted: NDArray[np.float64],
    forward: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Return the reward of one step (paper C.3), [B].

    Args:
        config: Rewards and penalties.
        completed: Where an instruction ended with this step, and is completed, [B].
        failed: Where one ran out of time with it, [B].
        drifted: By how much more than before boxes stand off the middle of their lanes, in cells, [B].
        forward: Speed along the heading behind the step in cells per second, [B].
    """
    reward = config.completed_reward * completed + config.failed_reward * failed
    reward -= config.drift_penalty * np.maximum(drifted, 0.0)
    reward -= config.backwards_penalty * (forward < _BACKWARDS)
    return reward.astype(np.float32)


class GoalTask:
    """B robots that follow instructions; the instruction in force is chosen before each step.

    Attributes:
        world: The physical world; its `goals` are those of the instructions in force.
        instruction: A_t, int64 [B].
        terminated: beta_t, bool [B].
        first: Whether tick t is the first of an episode, bool [B].
        planned: Whether the row follows the planner, bool [B].
    """

    def __init__(
        self,
        config: GoalTaskConfig,
        planner: Planner,
        episodes: EpisodeSource,
        rng: np.random.Generator,
        *,
        threads: int = 1,
    ) -> None:
        """Start an episode in every row.

        Args:
            config: Settings.
            planner: Gives the instructions of planned episodes; it sees true abstract states.
            episodes: Levels and seeds.
            rng: Source of all other randomness.
            threads: Threads for physics.
        """
        self.config = config
        self.world = World(
            config.batch,
            body=config.body,
            world=config.world,
            max_boxes=DIFFICULTIES[config.difficulty][1],
            threads=threads,
            tolerance=config.tolerance,
        )
        self._planner, self._episodes, self._rng = planner, episodes, rng
        self._memory = planner.initial_memory(config.batch)
        self._noise = TerminationNoise(config.batch, config.terminations, rng)
        b = config.batch
        self.instruction = np.full(b, int(Instruction.STAY), np.int64)
        self.terminated = np.zeros(b, np.bool_)
        self.first = np.ones(b, np.bool_)
        self.planned = np.zeros(b, np.bool_)
        self._start_boxes = self.world.box_cell.copy()
        self._failures = np.zeros(b, np.int64)
        self._failed_at: deque[EpisodeSpec] = deque(maxlen=_REMEMBERED)
        self._completed = np.zeros(b, np.bool_)
        self._horizon = np.full(b, math.inf)
        self._begin_episodes(np.arange(b))
        self._issue(np.arange(b))

    @property
    def elapsed(self) -> NDArray[np.float64]:
        """Share of the time limit that the instruction in force has had, [B]."""
        return self._noise.elapsed / INSTRUCTION_LIMIT

    @property
    def forward_speed(self) -> NDArray[np.floating]:
        """Speed along the heading in cells per second, [B]."""
        return forward_speed(self.world.pose, self.world.velocity, self.world.body.cell_size)

    def observe(self, *, camera: bool = True) -> ControllerInput:
        """Return what controllers see in this tick, ground truth included; without `camera` frames are empty."""
        world, b = self.world, self.world.batch
        frame = world.render() if camera else np.zeros((b, 0, 0, 3), np.uint8)
        # What is completed is told of the instruction before, as everywhere in the graph.
        truth = world.truth()._replace(completed=self._completed.copy())
        return ControllerInput(
            self.instruction.copy(), frame, world.proprio.copy(), self.terminated.copy(), truth
        )

    def step(self, torque: NDArray[np.float32]) -> TaskStep:
        """Apply torques in [-1, 1], [B, U]; then end instructions and episodes and choose the next ones."""
        world, config = self.world, self.config
        before = drift(world)
        world.step(torque)
        completed = world.completed.copy()
        ended = self._noise.step(completed, self._distance()) | world.done
        failed = ended & ~completed & (self._noise.elapsed >= config.terminations.limit)
        reward = goal_reward(config, ended & completed, failed, drift(world) - before, self.forward_speed)
        if config.retry > 0.0:
            self._remember(np.flatnonzero(failed & (world.goals.kind != GoalKind.HOLD)))
        rows = np.flatnonzero(ended)
        # An instruction that the end of its episode cut short says nothing.
        judged = np.flatnonzero(ended & (completed | failed))
        outcomes = [self._outcome(b, bool(completed[b])) for b in judged.tolist()]
        self._failures = np.where(failed, self._failures + 1, np.where(ended, 0, self._failures))
        over = world.done | (ended & (world.steps >= self._horizon))
        over |= self._failures >= config.patience
        self._completed = completed & ~over
        episodes = [self._episode_end(b) for b in np.flatnonzero(over).tolist()]
        self.terminated, self.first = ended & ~over, over
        if over.any():
            self._begin_episodes(np.flatnonzero(over))
        if rows.size:
            self._issue(rows)
        return TaskStep(reward, (~(failed | over)).astype(np.float32), outcomes, episodes)

    def _remember(self, rows: NDArray[np.int64]) -> None:
        """Keep the situations in which the instructions in force began, to be tried again."""
        for b in rows.tolist():
            spec = self.world.episodes[b]
            assert spec is not None
            boxes = self._start_boxes[b, : self.world.box_count[b]]
            y, x = self.world.goals.origin_cell[b].tolist()
            # Where the robot or a box had strayed into the other's cell, there is no such level.
            with suppress(LevelError):
                self._failed_at.append(replace(spec, level=replace(spec.level, boxes=boxes, player=(y, x))))

    def _next_episode(self) -> EpisodeSpec:
        if self._failed_at and self._rng.random() < self.config.retry:
            return self._failed_at[int(self._rng.integers(len(self._failed_at)))]
        return self._episodes()

    def _episode_end(self, row: int) -> EpisodeEnd:
        world = self.world
        spec = world.episodes[row]
        seed = -1 if spec is None else spec.seed
        return EpisodeEnd(
            row, seed, bool(world.solved[row]), float(world.episode_return[row]), int(world.steps[row])
        )

    def _distance(self) -> NDArray[np.float64]:
        """Return the distance, beyond the tolerance, of what has to reach its target, in cells, [B]."""
        offsets = goal_offsets(self.world)
        push = self.world.goals.kind == GoalKind.PUSH
        pair = np.where(push[:, None], offsets[:, 2:], offsets[:, :2])
        return np.hypot(pair[:, 0], pair[:, 1]) - self.config.tolerance

    def _outcome(self, row: int, completed: bool) -> Outcome:
        world, goals = self.world, self.world.goals
        kind, index = GoalKind(int(goals.kind[row])), int(goals.box_index[row])
        expected = self._start_boxes[row].copy()
        if kind == GoalKind.PUSH and completed:
            expected[index] += goals.goal_cell[row] - goals.origin_cell[row]
        astray = bool((world.box_cell[row] != expected).any())
        astray |= bool((world.agent_cell[row] != goals.goal_cell[row]).any()) and completed
        across = abs(goal_offsets(world)[row, 3])
        return Outcome(
            row,
            kind,
            Instruction(int(goals.direction[row])),
            completed,
            int(self._noise.elapsed[row]),
            kind == GoalKind.PUSH and bool(across > self.config.tolerance),
            astray,
        )

    def _begin_episodes(self, rows: NDArray[np.int64]) -> None:
        config, rng = self.config, self._rng
        self.world.reset(rows, [self._next_episode() for _ in rows])
        self._failures[rows] = 0
        if config.horizon < math.inf:
            self._horizon[rows] = rng.exponential(config.horizon, len(rows))
        self.planned[rows] = rng.random(len(rows)) < config.planned
        if self._memory:
            self._memory = put_rows(self._memory, rows, self._planner.initial_memory(len(rows)))
        shaken = rows[rng.random(len(rows)) < config.misaligned]
        if shaken.size:
            self._misalign(shaken)

    def _misalign(self, rows: NDArray[np.int64]) -> None:
        config, rng, world = self.config, self._rng, self.world
        size, m, k = world.body.cell_size, len(rows), world.max_boxes
        pose = world.pose[rows].astype(np.float64)
        pose[:, :2] += rng.uniform(-1, 1, (m, 2)) * config.robot_offset * size
        # A box that is off along both axes would overlap a peg.
        lopsided = np.where(rng.random((m, k, 1)) < 0.5, [[1.0, 0.4]], [[0.4, 1.0]])
        boxes = world.box_position[rows] + rng.uniform(-1, 1, (m, k, 2)) * lopsided * config.box_offset * size
        world.place(rows, pose, boxes)

    def _issue(self, rows: NDArray[np.int64]) -> None:
        world = self.world
        previous = self.instruction.copy()
        astray = self._rng.random(world.batch) < self.config.astray
        random = np.zeros(world.batch, np.bool_)
        random[rows] = (~self.planned | astray)[rows]
        planned = rows[self.planned[rows]]
        if planned.size:
            state = world.abstract_state()[planned]
            decided, memory = self._planner.decide(state, take_rows(self._memory, planned))
            self.instruction[planned] = decided
            self._memory = put_rows(self._memory, planned, memory) if self._memory else ()
            if self.config.planned < 1.0:
                # No plan is left: the planner stays, the row goes on at random.
                lost = planned[decided == Instruction.STAY]
                self.planned[lost], random[lost] = False, True
        if random.any():
            kinds = feasible_kinds(world)
            for b in np.flatnonzero(random).tolist():
                self.instruction[b] = random_instruction(
                    kinds[b], int(previous[b]), self.config.instructions, self._rng
                )
        issued = np.zeros(world.batch, np.bool_)
        issued[rows] = True
        world.instruct(self.instruction, issued)
        self._start_boxes[rows] = world.box_cell[rows]
        self._noise.issue(rows)
