"""Checks of settings, each with an error that names the first that is out of its range."""

from __future__ import annotations

import math
from typing import Any


def check_counts(settings: Any, *names: str, least: int = 1) -> None:
    """Raise ValueError unless each of these settings is `least` at least."""
    _check(settings, names, least, math.inf, f"at least {least}")


def check_shares(settings: Any, *names: str) -> None:
    """Raise ValueError unless each of these settings is from 0 to 1."""
    _check(settings, names, 0.0, 1.0, "a share, from 0 to 1")


def check_positive(settings: Any, *names: str) -> None:
    """Raise ValueError unless each of these settings is a finite number above 0."""
    _check(settings, names, math.ulp(0.0), math.nextafter(math.inf, 0.0), "a number above 0")


def check_not_negative(settings: Any, *names: str) -> None:
    """Raise ValueError unless each of these settings is a finite number from 0 on."""
    _check(settings, names, 0.0, math.nextafter(math.inf, 0.0), "a finite number from 0 on")


def _check(settings: Any, names: tuple[str, ...], least: float, most: float, expected: str) -> None:
    for name in names:
        value = getattr(settings, name)
        if not least <= value <= most:
            raise ValueError(f"{name} is {value}: expected {expected}")
