"""Numbers as people read them."""

from __future__ import annotations

import math


def readable(value: float) -> str:
    """Return a number with three digits that count: 0.977, 12.5, 1,120, 1,234,567, 3.0e-05."""
    size = abs(value)
    if not math.isfinite(value) or size == 0:
        return f"{value:.0f}"
    if size >= 999.5:
        return f"{value:,.0f}"
    return f"{value:.3g}" if size >= 1e-4 else f"{value:.1e}"
