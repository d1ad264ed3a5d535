"""What the benchmark of the planner measures."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.planner import all_sides_milliseconds
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.symmetry import SYMMETRIES


def test_each_decision_that_is_to_look_from_all_sides_does_so(monkeypatch: pytest.MonkeyPatch) -> None:
    scores, looks = LearnedPlanner.scores, list[int]()

    def noted(planner: LearnedPlanner, states: Any, *others: Any) -> Any:
        looks.append(len(states))
        return scores(planner, states, *others)

    monkeypatch.setattr(LearnedPlanner, "scores", noted)
    found = all_sides_milliseconds(1, 0.0)
    assert looks[SYMMETRIES:] == [1] * 6 * SYMMETRIES, "after those by which it chooses states"
    assert 0.0 < found["median_ms"] <= found["p99_ms"] <= found["max_ms"]
