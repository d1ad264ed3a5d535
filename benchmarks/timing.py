"""How the benchmarks time a step."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np


def milliseconds(step: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of a step in milliseconds."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        step()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))
