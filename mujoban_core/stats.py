"""Statistics of success rates."""

from __future__ import annotations

import math


def wilson_interval(successes: int, n: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate (Wilson 1927).

    Args:
        successes: Number of successes, 0 <= successes <= n.
        n: Number of trials.
        z: Standard normal quantile; the default gives 95 % coverage.

    Returns:
        Lower and upper bound in [0, 1]; (0, 1) when there are no trials.

    Raises:
        ValueError: If the counts contradict each other.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"expected 0 <= successes <= n, got successes={successes}, n={n}")
    if n == 0:
        return 0.0, 1.0
    rate = successes / n
    scale = 1.0 / (1.0 + z * z / n)
    centre = scale * (rate + z * z / (2 * n))
    half = scale * z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # Rounding must not exclude the rate itself at 0 and 1.
    return max(0.0, min(centre - half, rate)), min(1.0, max(centre + half, rate))


def rate_error(successes: int, n: int) -> float:
    """Return the standard error of a success rate, by the rule of succession: where all succeed it is not 0.

    Args:
        successes: Number of successes, 0 <= successes <= n.
        n: Number of trials.
    """
    expected = (successes + 1) / (n + 2)
    return math.sqrt(expected * (1.0 - expected) / (n + 2))
