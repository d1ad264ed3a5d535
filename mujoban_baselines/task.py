"""What agents are trained on: the overall task, played by many robots for its own reward (paper D.1, appendix B).

Shapes: B robots, K boxes, U actuators.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.bodies import get_body
from mujoban_core.grid import CONTROL_PERIOD, MAX_BOXES
from mujoban_core.ranges import check_counts
from mujoban_rl.engine import State
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.sights import Sights, observe
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import draw_training_seeds, generate_level

Levels = Literal["hard", "curriculum", "easy"]
LEVELS: Final[dict[str, dict[int, float]]] = {
    "hard": {5: 1.0},
    "curriculum": {1: 0.25, 2: 0.25, 3: 0.2, 4: 0.2, 5: 0.1},
    "easy": {1: 1.0},
}
"""How often each difficulty is drawn (paper D.1)."""
_LONGEST: Final = 1e6
"""Seconds that no episode takes."""


class TaskStep(NamedTuple):
    """What a step of a task led to."""

    reward: NDArray[np.float32]
    """[B]."""
    terminated: NDArray[np.bool_]
    """The episode ended with this step for good, [B]."""
    truncated: NDArray[np.bool_]
    """Its time ran out with this step, [B]."""

    @property
    def over(self) -> NDArray[np.bool_]:
        """Where nothing of the episode follows, [B]."""
        return self.terminated | self.truncated


class Task(ABC):
    """B robots, each in an episode of its own."""

    batch: int
    """B."""

    @abstractmethod
    def observe(self, names: tuple[str, ...]) -> Sights:
        """Return copies of what is seen now."""

    @abstractmethod
    def step(self, torque: NDArray[np.float32]) -> TaskStep:
        """Apply torques in [-1, 1], [B, U], for one step; whose episode has ended stands still, without reward."""

    @abstractmethod
    def renew(self, rows: NDArray[np.int64]) -> dict[str, list[float]]:
        """Start other episodes in the given rows; return what to log of those that have ended, by name."""

    def state(self) -> State:
        """Return all that decides how the task goes on."""
        return State()

    def restore(self, state: State) -> None:  # noqa: B027 - goes with the default of `state`
        """Take over what `state` returned."""

    def close(self) -> None:  # noqa: B027 - most tasks hold nothing open
        """Free the cameras."""


@dataclass(frozen=True)
class TaskConfig:
    """The task as it is trained on."""

    levels: Levels = "hard"
    """Difficulties: the hardest alone, the curriculum over all of them, or the easiest alone."""
    episode_seconds: float | None = 45.0
    """Time limit of episodes, the paper's for partially observable agents (C.5); None: the body's, as in evaluation,
    240 s for the ball."""
    robots: int = 64
    """B, robots that each actor plays at once."""
    body: str = "ball"
    """The robot's body, by name."""
    world: str = DEFAULT_WORLD
    """The physical world: reference or eased."""

    def __post_init__(self) -> None:
        """Reject what nobody can play."""
        check_counts(self, "robots")
        if self.episode_seconds is not None and not CONTROL_PERIOD <= self.episode_seconds < _LONGEST:
            raise ValueError(
                f"episode_seconds is {self.episode_seconds}: expected from {CONTROL_PERIOD} to less than {_LONGEST:g}"
            )

    @property
    def steps(self) -> int:
        """Time limit of episodes in steps."""
        if self.episode_seconds is None:
            return get_body(self.body).time_limit
        return round(self.episode_seconds / CONTROL_PERIOD)


class MujobanTask(Task):
    """Levels for training, drawn at random, played for the reward of the world."""

    def __init__(self, config: TaskConfig, rng: np.random.Generator, *, threads: int = 1) -> None:
        """Start an episode in every row; levels and their difficulties come from `rng`."""
        self.batch, self._rng = config.robots, rng
        self._shares = LEVELS[config.levels]
        self._difficulty = np.zeros(self.batch, np.int64)
        self.world = World(
            self.batch, body=config.body, world=config.world, max_boxes=MAX_BOXES, time_limit=config.steps,
            threads=threads,
        )  # fmt: skip
        self._begin(np.arange(self.batch))

    def _begin(self, rows: NDArray[np.int64]) -> None:
        difficulty = self._rng.choice(list(self._shares), len(rows), p=list(self._shares.values()))
        seeds = draw_training_seeds(self._rng, len(rows))
        self._difficulty[rows] = difficulty
        self.world.reset(rows, [
            EpisodeSpec(generate_level(d, seed), seed)
            for d, seed in zip(difficulty.tolist(), seeds, strict=True)
        ])  # fmt: skip

    def observe(self, names: tuple[str, ...]) -> Sights:
        """Return copies of what is seen now."""
        return observe(self.world, names)

    def step(self, torque: NDArray[np.float32]) -> TaskStep:
        """Apply torques for one step."""
        self.world.step(torque)
        return TaskStep(self.world.reward.copy(), self.world.solved.copy(), self.world.truncated.copy())

    def renew(self, rows: NDArray[np.int64]) -> dict[str, list[float]]:
        """Start other episodes; of those that have ended, log outcome and return by difficulty."""
        outcomes: dict[str, list[float]] = {}
        for row in rows.tolist():
            for name, values in (("solved", self.world.solved), ("return", self.world.episode_return)):
                outcomes.setdefault(f"{name}/{self._difficulty[row]}", []).append(float(values[row]))
        self._begin(rows)
        return outcomes

    def state(self) -> State:
        """Return all that decides how the task goes on."""
        arrays = {**self.world.snapshot(np.arange(self.batch)), "difficulty": self._difficulty}
        tensors = {name: torch.from_numpy(np.array(values)) for name, values in arrays.items()}
        return State({"rng": self._rng.bit_generator.state}, tensors)

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._rng.bit_generator.state = state.values["rng"]
        arrays: Mapping[str, NDArray[Any]] = {name: tensor.numpy() for name, tensor in state.tensors.items()}
        self._difficulty[:] = arrays["difficulty"]
        self.world.restore(np.arange(self.batch), {k: v for k, v in arrays.items() if k != "difficulty"})

    def close(self) -> None:
        """Free the cameras."""
        self.world.close()
