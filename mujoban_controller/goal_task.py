"""The goal task in which the controller learns (paper C.3), over the vectorised world.

The robot gets instructions, random or from a planner, and is rewarded for each that it completes and for coming
nearer to it (`goal_rewards`). An instruction that ends is followed by the next: the return bootstraps through it,
except where one failed.

Shapes: B robots, M selected rows, P proprioceptive values, U actuators.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.goal_features import goal_offsets, privileged_features
from mujoban_controller.goal_rewards import REACH, GoalReward, fallen
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.instructions import TerminationNoise, feasible_kinds, random_instruction
from mujoban_core.grid import DIFFICULTIES, INSTRUCTION_LIMIT, OFFSETS_RC, OFFSETS_XY, Instruction
from mujoban_core.interfaces import ControllerInput, Planner, put_rows, take_rows
from mujoban_rl.engine import State
from mujoban_sim.driving import forward_speed
from mujoban_sim.goals import GoalKind
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level, LevelError

EpisodeSource = Callable[[], EpisodeSpec]
"""Yields the next episode to play."""
_NO_PLAN = 200
"""Decisions in a row without a plan after which a planned episode is given up: the level cannot be solved any more."""
_ENDLESS = 2.0**62
"""Steps that no episode has; checkpoints hold finite numbers alone."""
_CHANGING = (
    "instruction", "terminated", "first", "planned", "torque", "_without_plan", "_start_boxes", "_failures",
    "_completed", "_horizon",
)  # fmt: skip
"""The task's own arrays that change from tick to tick."""
_REMEMBERED = 256
"""Failures that are kept to be tried again."""


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
    fallen: bool
    """Whether the robot lies on its side or back."""


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
    truncated: NDArray[np.bool_]
    """Where the episode ended without a failure, [B]: its discount is 0 although there was more to come."""
    outcomes: list[Outcome]
    """Instructions that ended."""
    episodes: list[EpisodeEnd]
    """Episodes that ended."""


class GoalTask:
    """B robots that follow instructions; the instruction in force is chosen before each step.

    Attributes:
        world: The physical world; its `goals` are those of the instructions in force.
        instruction: A_t, int64 [B].
        terminated: beta_t, bool [B].
        first: Whether tick t is the first of an episode, bool [B].
        planned: Whether the row follows the planner, bool [B].
        torque: Applied in the tick before, zero on an episode's first, float32 [B, U].
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
        self.torque = np.zeros((b, self.world.body.action_size), np.float32)
        self._reward = GoalReward(config.reward)
        self._without_plan = np.zeros(b, np.int64)
        self._start_boxes = self.world.box_cell.copy()
        self._failures = np.zeros(b, np.int64)
        self._failed_at: deque[EpisodeSpec] = deque(maxlen=_REMEMBERED)
        self._completed = np.zeros(b, np.bool_)
        self._horizon = np.full(b, _ENDLESS)
        self._begin_episodes(np.arange(b))
        self._issue(np.arange(b))

    @property
    def elapsed(self) -> NDArray[np.float64]:
        """Ticks that the instruction in force has had, in units of `INSTRUCTION_LIMIT`, [B]."""
        return self._noise.elapsed / INSTRUCTION_LIMIT

    @property
    def forward_speed(self) -> NDArray[np.floating]:
        """Speed along the heading in cells per second, [B]."""
        return forward_speed(self.world.pose, self.world.velocity, self.world.body.cell_size)

    def state(self) -> State:
        """Return all that decides how the task goes on."""
        world = self.world.snapshot(np.arange(self.world.batch))
        arrays = {
            **{f"world/{name}": values for name, values in world.items()},
            **{f"task/{name}": getattr(self, name) for name in _CHANGING},
            **{f"noise/{name}": values for name, values in self._noise.arrays().items()},
            **{f"planner/{i}": values for i, values in enumerate(self._memory)},
        }
        failed_at = [(spec.level.to_text(), spec.seed) for spec in self._failed_at]
        return State(
            {"rng": self._rng.bit_generator.state, "failed_at": failed_at},
            {name: torch.from_numpy(np.array(values)) for name, values in arrays.items()},
        )

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._rng.bit_generator.state = state.values["rng"]
        self._failed_at.clear()
        self._failed_at.extend(EpisodeSpec(Level.from_text(text), seed) for text, seed in state.values["failed_at"])

        def part(name: str) -> dict[str, NDArray[Any]]:
            found = {k: v.numpy() for k, v in state.tensors.items() if k.startswith(f"{name}/")}
            return {k.removeprefix(f"{name}/"): v for k, v in found.items()}

        self.world.restore(np.arange(self.world.batch), part("world"))
        for name, values in part("task").items():
            setattr(self, name, values.copy())
        for name, values in self._noise.arrays().items():
            values[:] = part("noise")[name]
        memory = part("planner")
        self._memory = tuple(memory[str(i)].copy() for i in range(len(memory)))

    def features(self) -> NDArray[np.float32]:
        """Return what critic and privileged teacher see, [B, D]."""
        return privileged_features(self.world, self.elapsed, self.torque)

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
        before, change = self._reward.before(world), torque - self.torque
        world.step(torque)
        self.torque = np.array(torque, np.float32)
        completed, lying, offsets = world.completed.copy(), fallen(world), goal_offsets(world)
        ended = self._noise.step(completed, self._distance(offsets)) | world.done | lying
        beyond = self._beyond(completed, offsets[:, 2:])
        ended |= beyond
        failed = ended & ~completed & ((self._noise.elapsed >= config.terminations.limit) | beyond) | lying
        reward = self._reward.after(world, before, change, ended & completed, failed)
        if config.retry > 0.0:
            self._remember(np.flatnonzero(failed & (world.goals.kind != GoalKind.HOLD)))
        rows = np.flatnonzero(ended)
        # An instruction that the end of its episode cut short says nothing.
        judged = np.flatnonzero(ended & (completed | failed))
        achieved, across = completed & ~failed, np.abs(offsets[:, 3]) > config.tolerance
        outcomes = [self._outcome(b, bool(achieved[b]), bool(across[b]), bool(lying[b])) for b in judged.tolist()]
        self._failures = np.where(failed, self._failures + 1, np.where(ended, 0, self._failures))
        given_up = (self._failures >= config.patience) | (self._without_plan >= _NO_PLAN)
        over = world.done | lying | (ended & ((world.steps >= self._horizon) | given_up))
        self._completed = completed & ~over
        episodes = [self._episode_end(b) for b in np.flatnonzero(over).tolist()]
        self.terminated, self.first = ended & ~over, over
        if over.any():
            self._begin_episodes(np.flatnonzero(over))
        if rows.size:
            self._issue(rows)
        return TaskStep(reward, (~(failed | over)).astype(np.float32), over & ~failed, outcomes, episodes)

    def _beyond(self, completed: NDArray[np.bool_], left: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return where a pushed box, with so far to go along and across its lane, [B, 2], is past it for good, [B]."""
        if self.config.overshoot == math.inf:
            return np.zeros_like(completed)
        world, goals = self.world, self.world.goals
        resting = world.box_speed[np.arange(world.batch), goals.box_index] < 0.05 * world.body.cell_size
        stuck = (left[:, 0] < -0.02) & (np.hypot(*left.T) > self.config.tolerance) & resting
        return (goals.kind == GoalKind.PUSH) & ((left[:, 0] < -self.config.overshoot) | stuck) & ~completed

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

    def _distance(self, offsets: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return the distance, beyond the tolerance, of what has to reach its target, in cells, [B]."""
        push = self.world.goals.kind == GoalKind.PUSH
        pair = np.where(push[:, None], offsets[:, 2:], offsets[:, :2])
        return np.hypot(pair[:, 0], pair[:, 1]) - self.config.tolerance

    def _outcome(self, row: int, completed: bool, across: bool, lying: bool) -> Outcome:
        world, goals = self.world, self.world.goals
        kind, index = GoalKind(int(goals.kind[row])), int(goals.box_index[row])
        expected = self._start_boxes[row].copy()
        if kind == GoalKind.PUSH and completed:
            expected[index] += goals.goal_cell[row] - goals.origin_cell[row]
        astray = bool((world.box_cell[row] != expected).any())
        astray |= bool((world.agent_cell[row] != goals.goal_cell[row]).any()) and completed
        return Outcome(
            row,
            kind,
            Instruction(int(goals.direction[row])),
            completed,
            int(self._noise.elapsed[row]),
            kind == GoalKind.PUSH and across,
            astray,
            lying,
        )

    def _begin_episodes(self, rows: NDArray[np.int64]) -> None:
        config, rng = self.config, self._rng
        self.world.reset(rows, [self._next_episode() for _ in rows])
        self._failures[rows] = self._without_plan[rows] = 0
        self.torque[rows] = 0.0
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
        # A box that is off along both axes would overlap a peg.
        lopsided = np.where(rng.random((m, k, 1)) < 0.5, [[1.0, 0.4]], [[0.4, 1.0]])
        stray, off = self._stray(rows, rng.uniform(-1, 1, (m, k, 2)) * lopsided * config.box_offset)
        pose[:, :2] += stray * size
        world.place(rows, pose, world.box_position[rows] + off * size)

    def _stray(
        self, rows: NDArray[np.int64], off: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return offsets of robots from the centres of their cells, and of boxes from theirs, [M, 2] and [M, K, 2].

        A robot is up to halfway to a free cell, or to one of a box, which it then has pushed from where it was.

        Args:
            rows: int [M].
            off: Offsets of boxes before, in cells as well, [M, K, 2].
        """
        config, rng, world = self.config, self._rng, self.world
        heading = rng.integers(1, len(OFFSETS_XY), len(rows))
        cell = world.agent_cell[rows] + OFFSETS_RC[heading]
        ahead = (world.box_cell[rows] == cell[:, None]).all(-1)
        open_ = feasible_kinds(world)[rows, heading] != GoalKind.HOLD
        along = rng.uniform(0.0, np.where(open_, 0.5, config.robot_offset))[:, None]
        across = rng.uniform(-config.robot_offset, config.robot_offset, (len(rows), 1))
        axis = OFFSETS_XY[heading]
        apart = 1.0 + (off * axis[:, None]).sum(-1) - along
        pushed = (ahead * np.maximum(REACH - apart, 0.0))[..., None] * axis[:, None]
        return along * axis + across * np.stack([-axis[:, 1], axis[:, 0]], 1), off + pushed

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
            self._without_plan[planned] = np.where(decided == Instruction.STAY, self._without_plan[planned] + 1, 0)
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
        if world.body.turn is None:
            looked = world.steps - self._noise.elapsed < self.config.look
            goes_on = self._rng.random(world.batch) < self.config.instructions.stays_on
            goes_on &= ~self.first & (previous == Instruction.STAY) & ~looked
            self.instruction[issued & goes_on] = Instruction.STAY
        self.instruction[issued & (world.steps < self.config.look)] = Instruction.STAY
        world.instruct(self.instruction, issued)
        self._start_boxes[rows] = world.box_cell[rows]
        self._noise.issue(rows)
