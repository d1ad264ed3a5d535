"""A small task on pixels, which sound agents solve in minutes: walk to the red square and not to the blue one.

A zero on Mujoban is the task's and not a bug's where the same agent, trained by the same code, solves this one.

Shapes: B robots.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_baselines.task import Task, TaskStep
from mujoban_core.bodies import BALL
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE, MAX_BOXES, TARGET, WALL
from mujoban_rl.engine import State
from mujoban_sim.sights import Sights

_SKY: Final = 24
"""Rows at the top of frames in which nothing is drawn."""
_HALF: Final = 4
"""Half the edge of squares, in pixels."""
_SPEED: Final = 0.25
"""Of the largest action, in units of a step; the field is the square [-1, 1]^2."""
_NEAR: Final = 0.3
"""Distance at which a square is reached in both axes."""
_LIMIT: Final = 25
"""Steps of an episode."""
_COLOURS: Final = {"walker": (255, 255, 255), "goal": (255, 0, 0), "decoy": (0, 0, 255)}


class SquaresTask(Task):
    """+1 for the red square, which ends the episode, and -1 for the blue one, which does too; on the way, its progress.

    Both squares are to be found in the frame alone: `pose` says where the walker is. Sights have the shapes of
    Mujoban's, so that its agents play; o_pr is 0. The reward of a step is by how much it came nearer to the red square
    besides, so that an agent that reads the frame learns within minutes.
    """

    def __init__(self, rng: np.random.Generator, *, batch: int = 32) -> None:
        """Start episodes whose places come from `rng`."""
        self.batch, self._rng = batch, rng
        self._places = {name: np.zeros((batch, 2)) for name in _COLOURS}
        self._age = np.zeros(batch, np.int64)
        self._outcome = np.zeros(batch, np.float32)
        self._begin(np.arange(batch))

    def _begin(self, rows: NDArray[np.int64]) -> None:
        self._age[rows] = 0
        for row in rows.tolist():
            while True:
                drawn = self._rng.uniform(-0.85, 0.85, (len(_COLOURS), 2))
                gaps = np.abs(drawn[:, None] - drawn[None]).max(-1)
                if gaps[np.triu_indices(len(drawn), 1)].min() > 2 * _NEAR:
                    break
            for place, name in zip(drawn, _COLOURS, strict=True):
                self._places[name][row] = place

    def observe(self, names: tuple[str, ...]) -> Sights:
        """Return copies of what is seen now."""
        walker = self._places["walker"]
        none = np.zeros((self.batch, 1), np.float32)
        known: dict[str, Any] = {
            "proprio": lambda: np.zeros((self.batch, BALL.proprio_size), np.float32),
            "pose": lambda: np.concatenate([walker * GRID_SIZE / 2, none], 1, dtype=np.float32),
            "frame": self._draw,
            "top_down": self._draw,
            "abstract_state": self._abstract_state,
            "box_position": self._squares,
        }
        return {name: known[name]() for name in names}

    def _draw(self) -> NDArray[np.uint8]:
        frame = np.zeros((self.batch, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        size = np.array([FRAME_SIZE - _SKY, FRAME_SIZE]) - 2 * _HALF
        for name, colour in _COLOURS.items():
            # Shape [B, 2], (row, column).
            corner = (0.5 * (1.0 + self._places[name][:, ::-1]) * size).astype(np.int64)
            for row, (y, x) in enumerate(corner.tolist()):
                frame[row, _SKY + y : _SKY + y + 2 * _HALF, x : x + 2 * _HALF] = colour
        return frame

    def _abstract_state(self) -> NDArray[np.float32]:
        """Return a room in which the walker is the robot, the red square the target and the blue one a box."""
        state = np.zeros((self.batch, GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32)
        state[..., WALL] = 1.0
        state[:, 1:-1, 1:-1, WALL] = 0.0
        inner = GRID_SIZE - 2
        for channel, name in ((AGENT, "walker"), (TARGET, "goal"), (BOX, "decoy")):
            cell = 1 + ((1.0 + self._places[name]) / 2 * inner).astype(np.int64).clip(0, inner - 1)
            state[np.arange(self.batch), cell[:, 1], cell[:, 0], channel] = 1.0
        return state

    def _squares(self) -> NDArray[np.float32]:
        places = np.stack([self._places[name] for name in ("goal", "decoy")] * (MAX_BOXES // 2), 1)
        return (places * GRID_SIZE / 2).astype(np.float32)

    def step(self, torque: NDArray[np.float32]) -> TaskStep:
        """Walk by up to `_SPEED` in x and y; whose episode has ended stands still, without reward, as in the world."""
        walker = self._places["walker"]
        before = self._distance()
        # Whose age is 0 may have the outcome of the episode before.
        on = (self._age < _LIMIT) & ((self._outcome == 0.0) | (self._age == 0))
        walker[:] = (walker + _SPEED * torque * on[:, None]).clip(-1.0, 1.0)
        self._age += on
        # Shape [2, B].
        near = np.stack([(np.abs(self._places[name] - walker) < _NEAR).all(1) for name in ("goal", "decoy")])
        self._outcome[:] = near[0].astype(np.float32) - near[1]
        terminated = near[0] | near[1]
        reward = (self._outcome * on + before - self._distance()).astype(np.float32)
        return TaskStep(reward, terminated, (self._age >= _LIMIT) & ~terminated)

    def _distance(self) -> NDArray[np.float64]:
        """Return how far the walker is from the red square, [B]."""
        return np.linalg.norm(self._places["goal"] - self._places["walker"], axis=1)

    def renew(self, rows: NDArray[np.int64]) -> dict[str, list[float]]:
        """Start other episodes; of those that ended, log which found the red square."""
        found = (self._outcome[rows] > 0).astype(float).tolist()
        self._begin(rows)
        return {"solved": found}

    def state(self) -> State:
        """Return all that decides how the task goes on."""
        arrays = {**self._places, "age": self._age, "outcome": self._outcome}
        return State({"rng": self._rng.bit_generator.state}, {k: torch.from_numpy(v) for k, v in arrays.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._rng.bit_generator.state = state.values["rng"]
        for name in self._places:
            self._places[name] = state.tensors[name].numpy()
        self._age, self._outcome = state.tensors["age"].numpy(), state.tensors["outcome"].numpy()
