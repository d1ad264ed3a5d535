"""Learning curves of any run: the metric that is asked for, at equal samples and at equal CPU time."""

from __future__ import annotations

import json
from functools import partial

import pytest

from mujoban_core.program import exit_status
from mujoban_rl import curves


@pytest.fixture
def run(tmp_path):
    """Return a run that was judged three times, as trainers of controllers write it."""
    folder = tmp_path / "teacher"
    folder.mkdir()
    lines = [
        {"step": 100_000 * i, "cpu_seconds": 600.0 * i, "evaluation/success_rate": i / 4, "evaluation/steps": 900.0 / i}
        for i in (1, 2, 3)
    ]
    lines.insert(1, {"step": 150_000, "cpu_seconds": 900.0, "loss/policy": 0.5})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def shown(capsys, run, *arguments):
    """Return the output that the command has for some arguments, and what it says on stderr."""
    picture = run / "picture.png"
    status = exit_status("curves", partial(curves.main, [str(run), *arguments, "--out", str(picture)]))
    said = capsys.readouterr()
    assert (status == 0) == picture.exists()
    return said.out.splitlines(), said.err.strip()


def test_success_is_drawn_of_a_run_whatever_it_trains(run, capsys):
    lines, _ = shown(capsys, run)
    assert lines[0] == "Success rate, linear between evaluations"
    assert "| 200,000 | 50.0 % |" in lines and "| 30 | 75.0 % |" in lines


def test_a_run_too_short_for_a_row_is_told_how_to_get_one(run, capsys):
    lines, _ = shown(capsys, run, "--every-samples", "500000")
    assert lines[2].startswith("No run has evaluations before and after a row of samples: --every-samples")
    assert "| 30 | 75.0 % |" in lines


def test_another_metric_is_drawn_in_its_own_unit(run, capsys):
    lines, _ = shown(capsys, run, "--metric", "evaluation/steps", "--names", "ant", "--every-minutes", "15")
    assert lines[0] == "Steps, linear between evaluations"
    assert "| 100,000 | 900 |" in lines and "| 15 | 675 |" in lines


def test_a_metric_that_no_run_has_is_refused_with_those_that_there_are(run, capsys):
    _, error = shown(capsys, run, "--metric", "evaluation/sucess_rate")
    assert error.splitlines() == [
        "curves: error: evaluation/sucess_rate: in none of the runs, expected a metric of theirs, such as "
        "evaluation/steps, evaluation/success_rate"
    ]


def test_a_folder_without_metrics_is_refused(tmp_path, capsys):
    _, error = shown(capsys, tmp_path)
    assert error == f"curves: error: {tmp_path}: no metrics.jsonl, expected the run directory of a trainer"
