"""Checks of options, each with an error that names the first that is out of its range."""

from __future__ import annotations

import math
from typing import Any


def check_counts(options: Any, *names: str, least: int = 1) -> None:
    """Raise ValueError unless each of these options is `least` at least."""
    _check(options, names, least, math.inf, f"{least} at least")


def check_shares(options: Any, *names: str) -> None:
    """Raise ValueError unless each of these options is from 0 to 1."""
    _check(options, names, 0.0, 1.0, "a share, from 0 to 1")


def check_positive(options: Any, *names: str) -> None:
    """Raise ValueError unless each of these options is a finite number above 0."""
    _check(options, names, math.ulp(0.0), math.nextafter(math.inf, 0.0), "a number above 0")


def _check(options: Any, names: tuple[str, ...], least: float, most: float, expected: str) -> None:
    for name in names:
        value = getattr(options, name)
        if not least <= value <= most:
            raise ValueError(f"--{name.replace('_', '-')} {value}: expected {expected}")
