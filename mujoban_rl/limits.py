"""What ends a training run, or a step of it: time, numbers that are not finite."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from mujoban_rl.progress import Progress


class NaNGuard:
    """Keep non-finite updates away from the weights; give up when they do not stop."""

    def __init__(self, patience: int = 20) -> None:
        """Tolerate at most `patience` non-finite steps in a row."""
        self.patience = patience
        self.skipped = 0
        """Steps refused so far."""
        self._in_a_row: Counter[str] = Counter()

    def accept(self, *values: Tensor | float, part: str = "") -> bool:
        """Return whether all values (losses, gradient norm) are finite; if not, the step must be skipped.

        Args:
            values: Anything that a number which is not finite would show in.
            part: Which of an update's steps, where there are several: what is in a row is counted for each.

        Raises:
            FloatingPointError: After `patience` refusals in a row.
        """
        finite = all(
            bool(torch.isfinite(v).all()) if isinstance(v, Tensor) else math.isfinite(v) for v in values
        )
        self._in_a_row[part] = 0 if finite else self._in_a_row[part] + 1
        self.skipped += not finite
        if self._in_a_row[part] > self.patience:
            raise FloatingPointError(f"training diverged: {self._in_a_row[part]} non-finite steps in a row")
        return finite


class TimeLimit:
    """Wall-clock limit of one bit of a run."""

    def __init__(self, seconds: float | None) -> None:
        """Count from now; None never ends.

        Raises:
            ValueError: If the limit is below 0 or no number.
        """
        if seconds is not None and not seconds >= 0.0:
            raise ValueError(f"a limit of {seconds:g} seconds: expected 0 or more")
        self._seconds = math.inf if seconds is None else seconds
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the limit was made."""
        return time.monotonic() - self._start

    @property
    def reached(self) -> bool:
        """Whether the time is up."""
        return self.elapsed >= self._seconds


@dataclass(frozen=True)
class Limits:
    """What ends one bit of a run."""

    time: TimeLimit
    samples: float
    updates: float

    def reached(self, progress: Progress) -> bool:
        """Return whether one of the limits is reached."""
        return self.time.reached or progress.samples >= self.samples or progress.updates >= self.updates
