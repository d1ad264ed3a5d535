"""Statistics of success rates."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Hashable, Sequence
from typing import Final

NORMAL_95: Final = 1.959963984540054
"""Standard normal quantile of an interval with 95 % coverage, on both sides."""


def wilson_interval(successes: int, n: int, z: float = NORMAL_95) -> tuple[float, float]:
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


def design_effect(outcomes: Sequence[float], clusters: Sequence[Hashable]) -> float:
    """Return how many times the variance of a mean grows by trials of one cluster being alike (Kish 1965), at least 1.

    Args:
        outcomes: One number a trial, at least one.
        clusters: The cluster of each.
    """
    mean = sum(outcomes) / len(outcomes)
    sums: dict[Hashable, float] = defaultdict(float)
    for outcome, cluster in zip(outcomes, clusters, strict=True):
        sums[cluster] += outcome - mean
    simple = sum((outcome - mean) ** 2 for outcome in outcomes)
    if not simple:  # nothing is known of how much trials of a cluster differ: as if they did not
        return len(outcomes) / len(sums)
    return max(1.0, cluster_variance(list(sums.values())) / simple)


def cluster_variance(sums: Sequence[float]) -> float:
    """Return the variance of the sum of independent numbers whose mean is 0, one a cluster."""
    return sum(value**2 for value in sums) * len(sums) / max(len(sums) - 1, 1)


def rate_error(successes: int, n: int) -> float:
    """Return the standard error of a success rate, by the rule of succession: where all succeed it is not 0.

    Args:
        successes: Number of successes, 0 <= successes <= n.
        n: Number of trials.
    """
    expected = (successes + 1) / (n + 2)
    return math.sqrt(expected * (1.0 - expected) / (n + 2))


def paired_difference(lost: int, won: int, n: int, z: float = NORMAL_95) -> tuple[float, float, float]:
    """Return the difference of two success rates on the same trials, with its 95 % interval (Agresti & Min 2005).

    Args:
        lost: Number of trials in which the first alone succeeded.
        won: Number of trials in which the second alone did.
        n: Number of trials, at least 1.
        z: Standard normal quantile; the default gives 95 % coverage.

    Returns:
        Success rate of the second less that of the first; lower and upper bound. All in [-1, 1].
    """
    # Half a trial more in each cell of the table of both outcomes, so that the interval of no difference is no point.
    total, b, c = n + 2.0, lost + 0.5, won + 0.5
    centre = (c - b) / total
    half = z * math.sqrt(b + c - (c - b) ** 2 / total) / total
    return (won - lost) / n, max(-1.0, centre - half), min(1.0, centre + half)


def sign_test(lost: int, won: int) -> float:
    """Return how probable it is that chance alone sets two numbers of trials at least so far apart (exact McNemar).

    Args:
        lost: Number of trials in which the first alone succeeded.
        won: Number of trials in which the second alone did.
    """
    n = lost + won
    tail = sum(math.comb(n, k) for k in range(min(lost, won) + 1))
    return min(1.0, 2 * tail / 2**n)
