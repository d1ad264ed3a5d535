"""Reports list how often the levels for tests were used."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from mujoban_controller import evaluate as controller
from mujoban_core.reports import count_uses, give_report
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


@pytest.mark.parametrize(
    ("main", "options"),
    [(planner.main, ()), (controller.main, ("--driver", "scripted"))],
    ids=["planner", "controller"],
)
def test_a_use_of_test_levels_that_no_file_takes_is_said(
    main: Callable[[Sequence[str]], int], options: Sequence[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--difficulty", "1", "--episodes", "2", *options]
    assert main([*few, "--seed", "1000"]) == 0
    said = "test levels were used, seeds 1000 to 1001, and this is written nowhere: --json FILE notes it"
    assert capsys.readouterr().err.splitlines().count(said) == 1
    assert main([*few, "--seed", "1000", "--json", str(tmp_path / "report.json")]) == 0
    assert main([*few, "--seed", "5000000"]) == 0
    assert "test levels" not in capsys.readouterr().err


def test_parts_of_an_evaluation_are_one_use_and_each_further_look_at_a_level_is_another() -> None:
    def use(first: int, last: int, planner: str = "a", **other: Any) -> dict[str, Any]:
        game = {"seed": first, "difficulty": 5}
        return {"commit": "c", "weights": {"planner": planner}, "seeds": [first, last], "played": game} | other

    halves = [use(0, 3), use(4, 7, commit="d")]
    assert count_uses([]) == 0 and count_uses(halves) == 1
    assert count_uses([*halves, use(0, 3)]) == 1, "an entry that is there twice"
    assert count_uses([*halves, use(0, 3, when="later")]) == 2
    assert count_uses([*halves, use(4, 7, when="later")]) == 2
    assert count_uses([*halves, use(3, 4, commit="e")]) == 2
    assert count_uses([*halves, use(8, 9, planner="b")]) == 2
    assert count_uses([*halves, use(8, 9, played={"difficulty": 4})]) == 2
    assert count_uses([use(0, 3, played=None), use(2, 5, played=None)]) == 2


@pytest.mark.parametrize("damaged", [b"{", b"\xff\xfe{"])
def test_what_stands_in_a_damaged_report_is_replaced(tmp_path: Path, damaged: bytes) -> None:
    report = tmp_path / "report.json"
    report.write_bytes(damaged)
    give_report({"n": 1, "test_uses": [{"commit": "a"}]}, report)
    assert json.loads(report.read_text())["test_uses"] == [{"commit": "a"}]
