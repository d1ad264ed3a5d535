"""How the benchmarks time what they measure."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np


def work(function: Callable[[], int], seconds: float) -> tuple[int, float]:
    """Call a function that returns how many units it has done for some seconds; return all units and the seconds."""
    start, count = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < seconds:
        count += function()
    return count, spent


def rate(function: Callable[[], int], seconds: float) -> float:
    """Return how many units a second a function that returns its units does."""
    count, spent = work(function, seconds)
    return count / spent


def milliseconds(step: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of a step in milliseconds."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        step()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))
