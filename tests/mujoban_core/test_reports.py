"""Reports list how often the levels for tests were used."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from mujoban_controller import evaluate as controller
from mujoban_core.reports import give_report
from mujoban_planner import evaluate as planner


@pytest.mark.parametrize(
    ("main", "options"),
    [(planner.main, ()), (controller.main, ("--driver", "scripted"))],
    ids=["planner", "controller"],
)
def test_evaluating_a_module_on_test_levels_is_noted_with_what_was_noted_before(
    main: Callable[[Sequence[str]], int], options: Sequence[str], tmp_path: Path
) -> None:
    report = tmp_path / "report.json"
    few = ["--difficulty", "1", "--episodes", "2", "--json", str(report), *options]
    for seed in (1000, 2000):
        assert main([*few, "--seed", str(seed)]) == 0
    content = json.loads(report.read_text())
    assert [use["seeds"] for use in content["test_uses"]] == [[1000, 1001], [2000, 2001]]
    assert all(use["weights"] == content["weights"] and "commit" in use for use in content["test_uses"])
    assert all(use["played"]["difficulty"] == 1 for use in content["test_uses"])
    assert main([*few, "--seed", "5000000"]) == 0
    assert "test_uses" not in json.loads(report.read_text()), "a report on other levels is another one"


def test_what_stands_in_a_damaged_report_is_replaced(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    report.write_text("{")
    give_report({"n": 1, "test_uses": [{"commit": "a"}]}, report)
    assert json.loads(report.read_text())["test_uses"] == [{"commit": "a"}]
