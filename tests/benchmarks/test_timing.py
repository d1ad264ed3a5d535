"""How the benchmarks time what they measure."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from benchmarks import timing


def test_a_rate_is_of_all_that_was_done_in_the_time_that_it_took(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    def step() -> int:
        now[0] += 0.4
        return 2

    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    assert timing.work(step, 1.0) == (6, pytest.approx(1.2))
    assert timing.rate(step, 1.0) == pytest.approx(5.0)
