"""Where the estimator is wrong about cells that it has seen: how often that was, and states with as many such errors.

Errors are hardly ever single cells anywhere. They are made where a cell was only seen from afar, at the edge of what
was seen, and several at once in a state that is hard to see. `measure_errors` counts them in bags of the running stack.

Shapes: B states, K kinds of errors, N = `grid.GRID_SIZE`, F = 2 places (inside, at the edge of what was seen), V = 7
distances (the nearest from which a cell was in view, in cells: 0 to 5, and more).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.camera import CameraMount
from mujoban_core.grid import BOX, GRID_SIZE, TARGET, WALL, cell_to_xy
from mujoban_core.visibility import cells_in_view

MEASURED: Final = Path(__file__).with_suffix(".json")
"""What `python -m mujoban_planner.measure_errors` wrote of the estimator that ships."""
KINDS: Final = (
    "wall_missing",
    "wall_extra",
    "target_missing",
    "target_missing_under_box",
    "target_extra",
    "box_missing",
    "box_extra",
)
"""What is wrong: K."""
_LAYERS: Final = (WALL, WALL, TARGET, TARGET, TARGET, BOX, BOX)
DISTANCES: Final = 7
_BELIEF: Final = 20.0
"""Cells that the mean rate of a kind counts for beside those that were found, of which there may be few."""
_SHAPES: Final = (0.02, 50.0)
"""Between these the shape of the states' factor lies."""
_HALF: Final = (GRID_SIZE - 1) / 2
_INNER: Final = np.pad(np.ones((GRID_SIZE - 2, GRID_SIZE - 2), np.bool_), 1)


class Seen(NamedTuple):
    """What a robot has seen of states."""

    cells: NDArray[np.bool_]
    """Cells that were in view, [B, N, N]."""
    nearest: NDArray[np.float64]
    """Chebyshev distance of each of them from the nearest place from which it was, in cells, [B, N, N]."""


def nothing_seen(batch: int) -> Seen:
    """Return what was seen of states before anything was, B of them."""
    shape = batch, GRID_SIZE, GRID_SIZE
    return Seen(np.zeros(shape, np.bool_), np.full(shape, float(GRID_SIZE)))


def look(
    seen: Seen,
    wall: NDArray[np.bool_],
    pose: NDArray[np.float64],
    camera: CameraMount,
    *,
    cell_size: float = 1.0,
    used: NDArray[np.bool_] | bool = True,
) -> Seen:
    """Return what was seen after one more view of each state.

    Args:
        seen: What had been seen.
        wall: True walls, [B, N, N].
        pose: (x [m], y [m], psi [rad]) in the map frame, [B, 3].
        camera: What makes the view.
        cell_size: Edge of a cell in metres.
        used: Whether it looks, [B]; all by default.
    """
    view = cells_in_view(wall, pose, camera, cell_size) & np.reshape(used, (-1, 1, 1))
    nearest = np.where(view, np.minimum(seen.nearest, distances(pose[:, :2] / cell_size)), seen.nearest)
    return Seen(seen.cells | view, nearest)


def positions(cell: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where cells, row * N + column, [B], are in the map frame: (x, y) in cells, [B, 2]."""
    return cell_to_xy(np.stack(np.divmod(cell, GRID_SIZE), -1), 1.0)


def distances(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Chebyshev distance of every cell from positions (x, y), both in cells, [B, N, N] from [B, 2]."""
    place = np.arange(GRID_SIZE) - _HALF
    x, y = position[:, 0, None, None], position[:, 1, None, None]
    return np.maximum(np.abs(place - x), np.abs(-place[:, None] - y))


class ErrorRates(NamedTuple):
    """How often a cell that was seen is wrong."""

    rate: NDArray[np.float64]
    """By kind, among the cells where the kind can be, [K, F, V]."""
    shape: float
    """Of the gamma-distributed factor that all cells of a state share: the smaller, the more errors come together."""
    certainty: NDArray[np.float64]
    """Mean distance of a wrong cell's logit from 0, exponentially distributed, by kind, [K]."""

    @property
    def hazard(self) -> NDArray[np.float64]:
        """What the factor multiplies, so that a cell is wrong as often as `rate` says over all states, [K, F, V]."""
        return self.shape * ((1.0 - self.rate) ** (-1.0 / self.shape) - 1.0)

    @classmethod
    def read(cls, path: Path = MEASURED) -> ErrorRates:
        """Return what `measure_errors` wrote.

        Raises:
            ValueError: If there is nothing of that kind.
        """
        expected = f"expected what `python -m mujoban_planner.measure_errors --json {path.name}` writes"
        try:
            found = json.loads(path.read_text())
            rates = np.array([found["rate"][kind] for kind in KINDS], np.float64)
            certainty = np.array([found["certainty"][kind] for kind in KINDS], np.float64)
            shape = float(found["shape"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: no rates of errors ({type(error).__name__}: {error}), {expected}") from None
        if rates.shape != (len(KINDS), 2, DISTANCES) or not ((rates >= 0.0) & (rates < 1.0)).all() or not shape > 0.0:
            raise ValueError(f"{path}: rates of errors of another form, {expected}")
        return cls(rates, shape, certainty)

    @property
    def report(self) -> dict[str, object]:
        """What `read` reads, as JSON values."""
        return {
            "rate": {kind: np.round(rate, 5).tolist() for kind, rate in zip(KINDS, self.rate, strict=True)},
            "shape": round(self.shape, 4),
            "certainty": {kind: round(x, 3) for kind, x in zip(KINDS, self.certainty.tolist(), strict=True)},
        }


def add_errors(
    estimate: NDArray[np.float64],
    truth: NDArray[np.bool_],
    seen: Seen,
    rates: ErrorRates,
    factor: float,
    rng: np.random.Generator,
) -> None:
    """Make cells that were seen wrong, in place.

    Args:
        estimate: What the estimator says, [B, N, N, 4].
        truth: Abstract states, [B, N, N, 4].
        seen: What it has seen.
        rates: How often it is wrong.
        factor: Times as often as `rates` says.
        rng: Source of the errors.
    """
    rate, certainty = rates.hazard * factor, rates.certainty
    at = _place(seen)
    state = rng.gamma(rates.shape, 1.0 / rates.shape, (len(truth), 1, 1))
    for kind, possible in enumerate(_possible(truth, seen)):
        layer = _LAYERS[kind]
        wrong = possible & (rng.random(possible.shape) < -np.expm1(-state * rate[kind][at]))
        logit = rng.exponential(certainty[kind], possible.shape)
        said = 1.0 / (1.0 + np.exp(np.where(truth[..., layer], logit, -logit)))
        estimate[..., layer] = np.where(wrong, said, estimate[..., layer])


class ErrorCounts:
    """Counts how often an estimator is wrong, and where."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.states = 0
        self.cells, self.wrong = np.zeros((2, len(KINDS), 2, DISTANCES), np.int64)
        self._logits = np.zeros(len(KINDS))
        self._places: list[NDArray[np.int64]] = []  # how many cells of each place a state has, [K * F * V] each
        self._free = 0  # states without an error

    def add(self, estimate: NDArray[np.floating], truth: NDArray[np.bool_], seen: Seen) -> None:
        """Count B estimates, [B, N, N, 4], of abstract states, [B, N, N, 4]."""
        at = np.stack(np.broadcast_arrays(*_place(seen)))
        index = at[0] * DISTANCES + at[1]
        places, errors = np.zeros((2, len(truth), len(KINDS), 2 * DISTANCES), np.int64)
        for kind, possible in enumerate(_possible(truth, seen)):
            p = np.clip(estimate[..., _LAYERS[kind]].astype(np.float64), 1e-6, 1.0 - 1e-6)
            wrong = possible & ((p > 0.5) != truth[..., _LAYERS[kind]])
            self._logits[kind] += np.abs(np.log(p[wrong] / (1.0 - p[wrong]))).sum()
            for count, cells in ((places, possible), (errors, wrong)):
                state, row, column = np.nonzero(cells)
                np.add.at(count[:, kind], (state, index[state, row, column]), 1)
        self.states += len(truth)
        self.cells += places.sum(0).reshape(self.cells.shape)
        self.wrong += errors.sum(0).reshape(self.wrong.shape)
        self._free += int((errors.sum((1, 2)) == 0).sum())
        self._places += list(places.reshape(len(truth), -1))

    @property
    def share_with_errors(self) -> float:
        """Share of the states in which a cell is wrong."""
        return 1.0 - self._free / max(self.states, 1)

    def rates(self) -> ErrorRates:
        """Return how often it was wrong; the factor of a state such that as many states have no error at all."""
        total, wrong = self.cells.sum((1, 2)), self.wrong.sum((1, 2))
        mean = (wrong + 1.0) / (total + _BELIEF)
        rate = (self.wrong + _BELIEF * mean[:, None, None]) / (self.cells + _BELIEF)
        certainty = np.maximum(self._logits / np.maximum(wrong, 1), 0.1)
        places = np.stack(self._places)
        low, high = _SHAPES
        for _ in range(40):
            shape = math.sqrt(low * high)
            hazard = places @ ErrorRates(rate, shape, certainty).hazard.ravel()
            free = ((1.0 + hazard / shape) ** -shape).mean()
            low, high = (low, shape) if free < self._free / self.states else (shape, high)
        return ErrorRates(rate, shape, certainty)


def _place(seen: Seen) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return whether each cell is at the edge of what was seen, 0 or 1, and how far from it it was, both [B, N, N]."""
    unseen = np.pad(~seen.cells & _INNER, ((0, 0), (1, 1), (1, 1)))
    edge = unseen[:, :-2, 1:-1] | unseen[:, 2:, 1:-1] | unseen[:, 1:-1, :-2] | unseen[:, 1:-1, 2:]
    distance = np.clip(np.rint(np.where(seen.cells, seen.nearest, 0.0)), 0, DISTANCES - 1)
    return edge.astype(np.int64), distance.astype(np.int64)


def _possible(truth: NDArray[np.bool_], seen: Seen) -> list[NDArray[np.bool_]]:
    """Return where an error of each kind can be, K of [B, N, N]: in seen cells, the outer wall excepted."""
    wall, target, box = truth[..., WALL], truth[..., TARGET], truth[..., BOX]
    places = (wall, ~wall, target & ~box, target & box, ~target & ~wall, box, ~box & ~wall)
    return [place & seen.cells & _INNER for place in places]
