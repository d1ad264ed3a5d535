"""Checks of what passes between NumPy and messages: shapes, finite numbers, probabilities, directions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.answers import are_probabilities
from mujoban_core.grid import Instruction as Direction

_LARGEST: Final[dict[type[np.floating[Any]], float]] = {t: float(np.finfo(t).max) for t in (np.float32, np.float64)}
_SAFE: Final = 1e76
"""Sum of squares below which every number has a place in either type."""


class ConversionError(ValueError):
    """A message or an array is not what its topic carries."""


def finite(what: str, values: ArrayLike, shape: tuple[int | None, ...], dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """Return values as an array after a check of shape (None: any length) and finiteness."""
    result = np.asarray(values, np.float64)
    if result.shape != shape and not _fits(result.shape, shape):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise ConversionError(f"{what} must have shape [{expected}], got {list(result.shape)}")
    # Written so that NaN fails as well, and what has no place in the type. The sum tells in a quarter of the time.
    if not np.vdot(result, result) <= _SAFE and not (np.abs(result) <= _LARGEST[dtype]).all():
        raise ConversionError(f"{what} must be finite, got {result.tolist()}")
    return result.astype(dtype, copy=False)


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(want in (None, have) for want, have in zip(wanted, shape, strict=True))


def check_probabilities(what: str, values: NDArray[np.floating[Any]]) -> None:
    """Refuse an array of numbers that are no probabilities."""
    if not are_probabilities(values):
        raise ConversionError(f"{what} must hold probabilities in [0, 1], got {values.min()} to {values.max()}")


def checked_probability(value: float) -> float:
    """Return a number that is a probability."""
    if not 0.0 <= (number := float(value)) <= 1.0:
        raise ConversionError(f"probability must lie in [0, 1], got {number}")
    return number


def checked_direction(value: int) -> int:
    """Return a number that is an instruction's."""
    if not 0 <= (direction := int(value)) < len(Direction):
        names = ", ".join(f"{d.value} ({d.name})" for d in Direction)
        raise ConversionError(f"direction must be one of {names}, got {direction}")
    return direction
