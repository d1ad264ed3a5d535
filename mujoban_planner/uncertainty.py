"""Abstract states as the planner really sees them: estimates are soft, and what was never in view is a guess.

Demonstrations know the whole level. What they do, averaged over all that may be hidden, is what a planner learns to do
with a part of it: to go and look for the boxes it misses, and not to push where it cannot know.

Shapes: B batch, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.camera import CameraMount
from mujoban_core.grid import AGENT, BOX, GRID_SIZE, TARGET, WALL
from mujoban_core.ranges import check_not_negative, check_shares
from mujoban_planner.estimator_errors import ErrorRates, Seen, add_errors, distances, look, nothing_seen, positions

_VIEWS = 6
"""Most views that a hidden state is put together from."""
_CAMERA = CameraMount(forward=0.15, height=0.0, pitch=0.0, fovy=80.0)
"""What makes the views, in a world of cells of 1 m; of its figures forward and fovy count.

A planner is of no body, and what few views leave unknown differs far more from state to state than between cameras
(docs/research/planner.md).
"""
_COMPLETE = 0.5
"""Share of the hidden states in which all that can be seen was seen; of the rest there are a few views."""
_PLACES = 2
"""Places beside its cell from which a robot that has seen all has looked: in bags of the running stack, cells that were
seen were as near to it as to these (`measure_errors`)."""
_UNSEEN = {WALL: (2.8, -1.0), TARGET: (-2.5, -5.0), BOX: (-2.2, -5.8)}
"""Layer -> mean logit of an estimator in cells that were never in view, where it is set and where it is not.

Measured, as the constants below, over 100,000 such cells of bags of the running stack, with an estimator before the one
that ships, whose guesses tell less apart (docs/research/planner.md).
"""
_ROCK = 4.0
"""The same for walls that no view can reach, once all else was seen."""
_OFFSET, _SCATTER = 1.5, 1.4
"""Standard deviations of these logits: of what a state's cells have in common, and of each by itself."""
_DOUBT = 12
"""A cell that was seen differs from the truth by half of the power of a uniform number: 5 % by more than 0.27."""

BORDER = np.pad(np.zeros((GRID_SIZE - 2, GRID_SIZE - 2), np.bool_), 1, constant_values=True)


def blur(state: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Return states of which the first share is blurred as estimates are: soft values, and single cells not seen.

    Args:
        state: Binary abstract states, [B, N, N, 4]; a copy is changed.
        share: Share of the batch, from its start.
        generator: CPU source of randomness.
    """
    n = int(len(state) * share)
    if n == 0:
        return state
    soft = state[:n].clone()

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(state.device)

    # Every value moves towards its opposite by less than one half; how much differs per state.
    blur = 0.45 * uniform(n, 1, 1, 1) * uniform(*soft.shape) ** 2
    unseen = uniform(n, *soft.shape[1:3]) < 0.15 * uniform(n, 1, 1)
    unseen &= soft[..., AGENT] == 0
    blur[..., AGENT] *= 0.5
    soft = soft + blur * (1.0 - 2.0 * soft)
    prior = soft.new_tensor([0.5, 0.06, 0.0, 0.06])
    for channel in (WALL, TARGET, BOX):
        # Boxes and targets that were never seen cannot be planned for; what is there may be uncertain, not gone.
        hide = unseen & (state[:n, ..., BOX] == 0) & (state[:n, ..., TARGET] == 0)
        soft[..., channel] = torch.where(hide, prior[channel], soft[..., channel])
    soft[:, [0, -1], :, WALL] = 1.0
    soft[:, :, [0, -1], WALL] = 1.0
    return torch.cat([soft, state[n:]])


@dataclass(frozen=True)
class UncertaintyConfig:
    """What defines how uncertain the states of a batch are."""

    noise: float = 0.0
    """Share of a batch whose abstract states are blurred, as estimates are."""
    hidden: float = 0.0
    """Share of a batch that shows only what the robot may have seen so far."""
    errors: float = 0.0
    """Times as often as measured that what the robot has seen is wrong in these states: 1 is as measured, 0 never."""

    @property
    def shows_estimates(self) -> bool:
        """Whether some states are shown as an estimator sees them."""
        return bool(self.noise or self.hidden)

    def __post_init__(self) -> None:
        """Reject what is no share and no factor, more than a batch, and errors in states that there are none of."""
        check_shares(self, "noise", "hidden")
        check_not_negative(self, "errors")
        if self.noise + self.hidden > 1.0:  # what is hidden starts from the truth, and not from what is blurred
            raise ValueError(f"noise is {self.noise} and hidden {self.hidden}: expected at most 1 together")
        if self.errors and not self.hidden:
            raise ValueError(f"errors is {self.errors}: expected 0, or a --hidden above 0, whose states have them")


class Uncertainty:
    """Makes the states of batches as uncertain as a configuration says."""

    def __init__(self, config: UncertaintyConfig) -> None:
        """Read how often the estimator errs, if it is to err."""
        self._config = config
        self._rates = ErrorRates.read() if config.errors else None

    def apply(self, state: Tensor, generator: torch.Generator, rng: np.random.Generator) -> Tensor:
        """Return binary abstract states, [B, N, N, 4], as they may be estimated, by these sources of randomness."""
        config = self._config
        state = blur(state, config.noise, generator)
        return hide_unseen(state, config.hidden, rng, self._rates, config.errors)


def hide_unseen(
    state: Tensor, share: float, rng: np.random.Generator, rates: ErrorRates | None = None, factor: float = 1.0
) -> Tensor:
    """Return states of which the last share shows only what a robot may have seen; the rest is the estimator's guess.

    What it may have seen is either all that can be seen, or a few views from its cell and from others on its way,
    such as a turn on the spot. Even then rock that no view reaches stays a guess. What was seen is right, if soft,
    unless there are rates of errors.

    Args:
        state: Abstract states, [B, N, N, 4]; a copy is changed.
        share: Share of the batch, from its end.
        rng: Source of the views, guesses and errors.
        rates: How often what was seen is wrong; never by default.
        factor: Times as often as these say.
    """
    n = int(len(state) * share)
    if n == 0:
        return state
    part = state[len(state) - n :].cpu().numpy()
    complete = np.arange(n) < n * _COMPLETE
    truth = part > 0.5
    some = _seen(truth[~complete], rng)
    seen = np.concatenate([visible(truth[complete]), some.cells])
    estimate = np.abs(part - 0.5 * rng.random(part.shape) ** _DOUBT)
    guess = guesses(truth, complete, rng)
    estimate = np.where(seen[..., None], estimate, guess)
    if rates is not None:
        nearest = np.concatenate([_from_places(truth[complete], rng), some.nearest])
        add_errors(estimate, truth, Seen(seen, nearest), rates, factor, rng)
    estimate[..., AGENT] = part[..., AGENT]
    return torch.cat([state[: len(state) - n], torch.from_numpy(estimate.astype(np.float32)).to(state.device)])


def guesses(state: NDArray[np.bool_], complete: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return what the estimator says of cells that it has never seen, [B, N, N, 4]; zeros in the agent's layer.

    Args:
        state: Abstract states, [B, N, N, 4].
        complete: Whether all that can be seen was seen, so that what is left must be rock, [B].
        rng: Source of the guesses.
    """
    n, guess = len(state), np.zeros(state.shape)
    for layer, (present, absent) in _UNSEEN.items():
        likely = np.where(complete, _ROCK, present) if layer == WALL else np.full(n, present)
        logit = np.where(state[..., layer], likely[:, None, None], absent)
        logit += rng.normal(0.0, _OFFSET, (n, 1, 1)) + rng.normal(0.0, _SCATTER, logit.shape)
        guess[..., layer] = 1.0 / (1.0 + np.exp(-logit))
    return guess


def visible(state: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells that can be seen from somewhere, [B, N, N]: the floor and what is next to it, and the border."""
    floor = np.pad(~state[..., WALL], ((0, 0), (1, 1), (1, 1)))
    windows = np.lib.stride_tricks.sliding_window_view(floor, (3, 3), axis=(1, 2))
    return windows.any((3, 4)) | BORDER


def _seen(state: NDArray[np.bool_], rng: np.random.Generator) -> Seen:
    """Return what a robot has had in view after some views; the border is always known."""
    n = len(state)
    here = state[..., AGENT].reshape(n, -1).argmax(1)
    elsewhere = _anywhere(state, _VIEWS, rng)
    stays = rng.random((n, _VIEWS)) < rng.random((n, 1))
    stays[:, 0] = True
    cell = np.where(stays, here[:, None], elsewhere)
    heading = 0.5 * np.pi * rng.integers(0, 4, cell.shape) + rng.normal(0.0, 0.2, cell.shape)
    count, seen = rng.integers(1, _VIEWS + 1, n), nothing_seen(n)
    for view in range(_VIEWS):
        pose = np.concatenate([positions(cell[:, view]), heading[:, view, None]], 1)
        seen = look(seen, state[..., WALL], pose, _CAMERA, used=view < count)
    return seen._replace(cells=seen.cells | BORDER)


def _from_places(state: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return how near a robot came to each cell that looked around in its cell and a few others, [B, N, N]."""
    here = state[..., AGENT].reshape(len(state), -1).argmax(1)
    cells = np.concatenate([here[:, None], _anywhere(state, _PLACES, rng)], 1)
    return np.min([distances(positions(cell)) for cell in cells.T], axis=0)


def _anywhere(state: NDArray[np.bool_], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return random floor cells without a box, [B, count], each the greatest of random numbers."""
    n = len(state)
    floor = ~state[..., WALL].reshape(n, -1) & ~state[..., BOX].reshape(n, -1)
    return (rng.random((n, count, floor.shape[1])) * floor[:, None]).argmax(2)
