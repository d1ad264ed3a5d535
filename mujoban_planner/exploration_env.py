"""Going and looking, in hundreds of levels at once: a grid model of what a camera behind full walls gets to see.

A robot walks from cell to cell, sees what lies ahead of it, and turns on the spot where it stays; it pushes nothing.
What it perceives of cells that it has not seen is what the estimator guesses there (`mujoban_planner.uncertainty`).

Shapes: E levels, M of their rows, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_core.grid import AGENT, BOX, GRID_SIZE, OFFSETS_RC, WALL, Instruction, cell_to_xy
from mujoban_core.look_around import WALKS
from mujoban_core.viewpoints import WALK_HEADINGS, survey, turn_headings
from mujoban_core.visibility import cells_in_view
from mujoban_planner.uncertainty import BORDER, guesses, visible
from mujoban_rl.engine import State

SHOWN, GAIN, DISTANCE, FIRST = range(4, 8)
"""Channels behind those of the abstract state: cells that have been in view, and the `Survey` from the robot's cell."""
_CHANGING: Final = ("level", "agent", "seen", "guess", "steps")


def observe_estimate(
    abstract_state: NDArray[np.float32], shown: NDArray[np.bool_], body: Body
) -> NDArray[np.float32]:
    """Return what an explorer is told, [N, N, 8]: an estimate, which cells have been in view, what each cell promises.

    Args:
        abstract_state: Estimate, [N, N, 4].
        shown: Cells that have been in view, [N, N].
        body: Carries the camera.
    """
    promises = survey(abstract_state, shown, body)
    return np.stack([*np.moveaxis(abstract_state, -1, 0), shown, *promises], -1).astype(np.float32)


@dataclass(frozen=True)
class ExplorationReward:
    """What looking is worth; in the unit of the planner's rewards."""

    cell: float = 0.1
    """Of each cell that comes into view for the first time."""
    move: float = 0.05
    """Cost of a step."""
    look: float = 0.15
    """Cost of a turn on the spot."""


class ExplorationStep(NamedTuple):
    """Outcome of an action, [E] each."""

    reward: NDArray[np.float32]
    complete: NDArray[np.bool_]
    """Whether all that can be seen was seen: the episode terminated."""
    truncated: NDArray[np.bool_]
    """Whether its instructions were used up."""


class ExplorationEnvironment:
    """E levels that are explored.

    Observation: see `observe_estimate`, float32 [E, N, N, 8]. Action: STAY (a turn on the spot), a
    step north, east, south or west. Reward: see `ExplorationReward`. Every episode begins with a turn. To stop is worth
    nothing and needs no action: whoever expects less of every action stops.
    """

    def __init__(
        self, levels: NDArray[np.float32], rng: np.random.Generator, body: Body, reward: ExplorationReward | None = None
    ) -> None:
        """Begin an episode in each level.

        Args:
            levels: Abstract states, [E, N, N, 4].
            rng: Source of the estimator's guesses.
            body: Carries the camera.
            reward: Weights of the reward.
        """
        self._rng, self._body, self._reward = rng, body, reward or ExplorationReward()
        self._turn = turn_headings(body.camera)
        batch = len(levels)
        self.level = np.zeros(levels.shape, np.bool_)
        """Abstract states as they are; the robot's layer is that of the start."""
        self.agent = np.zeros((batch, 2), np.int64)
        """(row, column)."""
        self.seen = np.zeros((batch, GRID_SIZE, GRID_SIZE), np.bool_)
        """Cells that have been in view."""
        self.guess = np.zeros(self.level.shape, np.float32)
        self.steps = np.zeros(batch, np.int64)
        self.begin(np.arange(batch), levels)

    def begin(self, rows: NDArray[np.int64], levels: NDArray[np.float32]) -> None:
        """Begin episodes in other levels, [M, N, N, 4], in the given rows, [M]."""
        self.level[rows] = levels > 0.5
        self.guess[rows] = guesses(self.level[rows], np.zeros(len(rows), np.bool_), self._rng)
        self.agent[rows] = np.argwhere(self.level[rows][..., AGENT])[:, 1:]
        self.seen[rows], self.steps[rows] = BORDER, 0
        self._look(rows)

    def _look(self, rows: NDArray[np.int64]) -> None:
        turned = np.repeat(rows, len(self._turn))
        view = self._view(turned, np.tile(self._turn, len(rows)))
        self.seen[rows] |= view.reshape(len(rows), len(self._turn), GRID_SIZE, GRID_SIZE).any(1)

    def _view(self, rows: NDArray[np.int64], heading: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which cells a robot sees in its cell with a heading, [M, N, N]."""
        pose = np.concatenate([cell_to_xy(self.agent[rows], self._body.cell_size), heading[:, None]], -1)
        return cells_in_view(self.level[rows][..., WALL], pose, self._body.camera, self._body.cell_size)

    @property
    def remaining(self) -> NDArray[np.int64]:
        """Cells that can be seen from somewhere and have not been, [E]."""
        return (visible(self.level) & ~self.seen).sum((1, 2))

    def observe(self) -> NDArray[np.float32]:
        """Return what an explorer is told of every level, [E, N, N, 8]."""
        state = np.where(self.seen[..., None], self.level, self.guess)
        state[..., AGENT] = 0.0
        state[np.arange(len(state)), self.agent[:, 0], self.agent[:, 1], AGENT] = 1.0
        estimates = zip(state.astype(np.float32), self.seen, strict=True)
        return np.stack([observe_estimate(estimate, shown, self._body) for estimate, shown in estimates])

    def step(self, action: NDArray[np.int64]) -> ExplorationStep:
        """Execute an action in every level, [E]."""
        before, config = self.seen.sum((1, 2)), self._reward
        moves = action != Instruction.STAY
        ahead = self.agent + OFFSETS_RC[action]
        row, column = ahead.T
        every = np.arange(len(action))
        blocked = self.level[every, row, column, WALL] | self.level[every, row, column, BOX]
        self.agent = np.where((moves & ~blocked)[:, None], ahead, self.agent)
        walked, looked = np.flatnonzero(moves), np.flatnonzero(~moves)
        self.seen[walked] |= self._view(walked, WALK_HEADINGS[action[walked]])
        self._look(looked)
        self.steps += 1
        reward = config.cell * (self.seen.sum((1, 2)) - before) - np.where(moves, config.move, config.look)
        complete = self.remaining == 0
        return ExplorationStep(reward.astype(np.float32), complete, ~complete & (self.steps >= WALKS))

    def state(self) -> State:
        """Return all that changes, levels included."""
        tensors = {name: torch.from_numpy(getattr(self, name).copy()) for name in _CHANGING}
        return State({"rng": self._rng.bit_generator.state}, tensors)

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._rng.bit_generator.state = state.values["rng"]
        for name in _CHANGING:
            getattr(self, name)[...] = state.tensors[name].numpy()
