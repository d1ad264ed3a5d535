"""What a soak says of a run."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.soak import Options, slope, summary


def test_a_leak_is_seen_through_noise_and_a_flat_run_is_flat() -> None:
    rng = np.random.default_rng(0)
    hours = np.linspace(0.0, 2.0, 1440)
    noise = rng.normal(0.0, 3.0, len(hours))
    flat, leak = slope(hours, 500.0 + noise, 24), slope(hours, 500.0 + 4.0 * hours + noise, 24)
    assert flat["interval"][0] < 0.0 < flat["interval"][1]
    assert 0.0 < leak["interval"][0] < 4.0 < leak["interval"][1]
    assert leak["blocks"][-1] - leak["blocks"][0] == pytest.approx(8.0, abs=1.0)


def test_the_start_counts_for_nothing_and_too_short_a_run_is_refused() -> None:
    rows = [(0.01 * i, 100.0 if i < 5 else 500.0, 30.0, 9.0, 1.0, 200.0) for i in range(101)]
    assert summary(rows, Options())["megabytes"]["per_hour"] == 0.0
    with pytest.raises(ValueError, match="expected at least 3"):
        summary(rows[:2], Options())
