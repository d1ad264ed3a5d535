"""Learning curves side by side: what runs are said to have solved at equal samples and at equal CPU time."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from mujoban_core.program import exit_status
from mujoban_planner import curves


def run_of(folder: Path, *evaluations: tuple[int, float, float], difficulty: int = 5) -> Path:
    """Write the metrics of a run whose (samples, CPU seconds, solve rate) are given, with lines of training between."""
    folder.mkdir(parents=True)
    lines = []
    for samples, cpu_seconds, rate in evaluations:
        spent = {"step": samples, "cpu_seconds": cpu_seconds}
        lines += [{**spent, "train/policy": 1.0}, {**spent, f"evaluation/success_rate/{difficulty}": rate}]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def shown(capsys: pytest.CaptureFixture[str], tmp_path: Path, *arguments: str | Path) -> list[list[str]]:
    """Return the cells of all rows that the command prints for some arguments."""
    command_line = [*map(str, arguments), "--out", str(tmp_path / "picture.png")]
    assert exit_status("curves", partial(curves.main, command_line)) == 0
    lines = capsys.readouterr().out.splitlines()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]


def test_rates_stand_at_equal_samples_and_minutes_and_are_blank_where_nothing_was_measured(tmp_path, capsys):
    slow = run_of(tmp_path / "slow", (0, 0.0, 0.0), (150_000, 1200.0, 0.3), (250_000, 1800.0, 0.5))
    quick = run_of(tmp_path / "quick", (150_000, 60.0, 0.8), (450_000, 660.0, 0.9))
    assert shown(capsys, tmp_path, slow, quick, "--names", "moves", "pushes") == [
        ["samples", "moves", "pushes"],
        ["---:", "---:", "---:"],
        ["100,000", "20.0 %", ""],
        ["200,000", "40.0 %", "81.7 %"],
        ["300,000", "", "85.0 %"],
        ["400,000", "", "88.3 %"],
        ["CPU minutes", "moves", "pushes"],
        ["---:", "---:", "---:"],
        ["10", "15.0 %", "89.0 %"],
        ["20", "30.0 %", ""],
        ["30", "50.0 %", ""],
    ]


def test_the_published_curve_stands_beside_the_runs_at_its_own_budgets(tmp_path, capsys):
    run = run_of(tmp_path / "ours", (0, 0.0, 0.0), (100_000, 1.0, 0.7))
    rows = shown(capsys, tmp_path, run, "--published")
    assert rows[0] == ["samples", "ours", "DRC(3,3), published"]
    assert ["100,000", "70.0 %", ""] in rows and ["10,000,000", "", "34.0 %"] in rows
    assert ["2,000,000,000", "", "99.0 %"] in rows


def test_what_a_killed_run_had_come_to_after_its_last_checkpoint_does_not_count(tmp_path, capsys):
    lost, again = (300_000, 30.0, 0.9), (200_000, 20.0, 0.2)
    run = run_of(tmp_path / "run", (100_000, 10.0, 0.1), lost, again, (400_000, 40.0, 0.4))
    rates = {row[0]: row[1] for row in shown(capsys, tmp_path, run)}
    assert rates["200,000"] == "20.0 %" and rates["300,000"] == "30.0 %"


def test_a_run_without_evaluations_of_the_difficulty_is_a_column_of_blanks(tmp_path, capsys):
    empty = run_of(tmp_path / "empty", (100_000, 600.0, 1.0), difficulty=1)
    full = run_of(tmp_path / "full", (100_000, 600.0, 0.5))
    assert shown(capsys, tmp_path, empty, full)[2] == ["100,000", "", "50.0 %"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--every-samples", "0"], "every_samples is 0: expected at least 1"),
        (["--every-minutes", "-1"], "every_minutes is -1.0: expected a number above 0"),
        (["--names", "one"], "--names: 1 names, expected one for each of the 2 runs"),
        ([], "--names: run, run, expected another name for each run"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, options, said):
    runs = [str(run_of(tmp_path / folder / "run", (1, 1.0, 0.0))) for folder in "ab"]
    arguments = [*runs, *options, "--out", str(tmp_path / "picture.png")]
    assert exit_status("curves", partial(curves.main, arguments)) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and len(error.splitlines()) == 1
