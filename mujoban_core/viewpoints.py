"""Where a robot that knows only an estimate could look from, and what it would see there.

Shapes: V viewpoints, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.bodies import BALL, Body
from mujoban_core.camera import CameraMount
from mujoban_core.grid import AGENT, BOX, GRID_SIZE, OFFSETS_RC, OFFSETS_XY, WALL, Instruction, cell_to_xy
from mujoban_core.visibility import cells_in_view

MIN_GAIN: Final = 3
"""Cells that a viewpoint must promise to be worth a walk by the rule."""
_UNCERTAIN: Final = (0.05, 0.95)
"""A cell is unknown where the probability of a wall lies between these and it has not been in view."""
_OPAQUE: Final = 0.9
"""Probability of a wall from which on it hides what lies behind; guesses about unseen cells stay below."""
FREE: Final = 0.3
"""Probability of a wall or a box up to which the robot dares to walk into a cell."""
_WALK_COST: Final = 0.5
"""Cells of gain that one step of the way is worth by the rule."""
_VIEWS_OF_A_TURN: Final = 5
"""Views that together make a turn, of a camera of at least 72 degrees."""
WALK_HEADINGS: Final = np.arctan2(OFFSETS_XY[:, 1], OFFSETS_XY[:, 0])
"""Direction of travel of each instruction in radians; that of STAY is not used."""
_CELLS: Final = GRID_SIZE * GRID_SIZE
_STEPS: Final = OFFSETS_RC[:, 0] * GRID_SIZE + OFFSETS_RC[:, 1]
"""What an instruction adds to the number of the robot's cell."""


class Survey(NamedTuple):
    """What an estimate says of each cell as a place to look from, int64 [N, N] each."""

    gain: NDArray[np.int64]
    """Unknown cells that a turn there would show; 0 where no way leads."""
    distance: NDArray[np.int64]
    """Steps of the way there, -1 where none leads."""
    first: NDArray[np.int64]
    """The first of them; STAY where the robot is and where no way leads."""


def survey(abstract_state: NDArray[np.float32], seen: NDArray[np.bool_], body: Body = BALL) -> Survey:
    """Return what each cell promises.

    Args:
        abstract_state: Estimate, [N, N, 4].
        seen: Cells that have been in view, [N, N].
        body: Carries the camera.
    """
    wall = abstract_state[..., WALL]
    unknown = (wall > _UNCERTAIN[0]) & (wall < _UNCERTAIN[1]) & ~seen
    unknown[[0, -1]] = unknown[:, [0, -1]] = False
    free = (wall < FREE) & (abstract_state[..., BOX] < FREE)
    # A level ends in walls whatever an estimate says, and nobody walks off the grid.
    free[[0, -1]] = free[:, [0, -1]] = False
    distance, first = _walks(free.ravel(), int(np.argmax(abstract_state[..., AGENT])))
    gain = np.zeros(_CELLS, np.int64)
    if unknown.any():
        cells = np.flatnonzero(distance >= 0)
        gain[cells] = (_views(wall, cells, body, turn_headings(body.camera)) & unknown.ravel()).sum(1)
    return Survey._make(part.reshape(GRID_SIZE, GRID_SIZE) for part in (gain, distance, first))


def step_to_view(
    abstract_state: NDArray[np.float32], seen: NDArray[np.bool_], body: Body = BALL
) -> Instruction | None:
    """Return the first step to where a turn shows most that is unknown; STAY for here, None if nowhere does.

    Args:
        abstract_state: Estimate, [N, N, 4].
        seen: Cells that have been in view, [N, N].
        body: Carries the camera.
    """
    gain, distance, first = (part.ravel() for part in survey(abstract_state, seen, body))
    worth = np.where(gain >= MIN_GAIN, gain - _WALK_COST * distance, -np.inf)
    best = int(np.argmax(worth))
    return Instruction(int(first[best])) if np.isfinite(worth[best]) else None


def turn_headings(camera: CameraMount) -> NDArray[np.floating]:
    """Return headings in radians whose views together make a turn, [at least 5]."""
    views = max(_VIEWS_OF_A_TURN, math.ceil(360.0 / camera.fovy))
    return 2.0 * math.pi / views * np.arange(views)


def turn_view(abstract_state: NDArray[np.float32], body: Body = BALL) -> NDArray[np.bool_]:
    """Return which cells a turn in the robot's cell shows a body, by an estimate, [N, N] from [N, N, 4]."""
    here, headings = np.argmax(abstract_state[..., AGENT]), turn_headings(body.camera)
    return _views(abstract_state[..., WALL], np.array([here]), body, headings).reshape(GRID_SIZE, GRID_SIZE)


def walk_view(
    abstract_state: NDArray[np.float32], direction: Instruction, body: Body = BALL
) -> NDArray[np.bool_]:
    """Return which cells a robot sees that has walked into its cell in a direction, by an estimate, [N, N]."""
    here, heading = np.argmax(abstract_state[..., AGENT]), WALK_HEADINGS[[direction]]
    return _views(abstract_state[..., WALL], np.array([here]), body, heading).reshape(GRID_SIZE, GRID_SIZE)


def _views(
    wall: NDArray[np.float32], cells: NDArray[np.int64], body: Body, headings: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Return which cells are seen from each of `cells`, [V], with any of some headings, [V, N * N]."""
    x, y = cell_to_xy(np.stack(np.divmod(cells, GRID_SIZE), -1), body.cell_size).T
    turns = len(headings)
    pose = np.stack([np.repeat(x, turns), np.repeat(y, turns), np.tile(headings, len(cells))], -1)
    opaque = np.broadcast_to(wall > _OPAQUE, (len(pose), GRID_SIZE, GRID_SIZE))
    view = cells_in_view(opaque, pose, body.camera, body.cell_size)
    return np.any(view.reshape(len(cells), turns, _CELLS), axis=1)


@njit(cache=True, nogil=True)
def _walks(free: NDArray[np.bool_], start: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the walking distance from a cell to each, [N * N], -1 where none leads, and the first step of the way."""
    distance, first = np.full(free.size, -1), np.zeros(free.size, np.int64)
    queue = np.empty(free.size, np.int64)
    distance[start], queue[0], last = 0, start, 1
    done = 0
    while done < last:
        cell = queue[done]
        done += 1
        for instruction in range(1, len(_STEPS)):
            # What is free is not on the border, so that a step leads to a cell beside.
            beside = cell + _STEPS[instruction]
            if 0 <= beside < free.size and free[beside] and distance[beside] < 0:
                distance[beside] = distance[cell] + 1
                first[beside] = instruction if cell == start else first[cell]
                queue[last] = beside
                last += 1
    return distance, first
