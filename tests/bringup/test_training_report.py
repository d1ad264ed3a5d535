"""What the report of a run tells of its stages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import bringup.keep
from bringup.pipeline import Entry, Pipeline
from bringup.training_report import write_report


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Make what a run leaves that kept its teacher, and trained and evaluated a planner."""
    entries = {
        "teacher": Entry(["-m", bringup.keep.PROG], done=True),
        "planner": Entry(
            ["-m", "mujoban_planner.train"], done=True,
            ran_with=[{"commit": "abc-dirty", "torch": "2.0", "cores": 1, "machine_cores": 2}],
        ),
        "bags_first": Entry(["-m", "bringup.record"], done=True),
        "evaluation": Entry(["-m", "bringup.evaluate"], done=True),
    }  # fmt: skip
    (tmp_path / "pipeline.json").write_text(json.dumps({name: vars(entry) for name, entry in entries.items()}))
    for name in ("teacher", "planner"):
        lines = [
            {"step": 9 * i, "cpu_seconds": 10.0 * i, "loss/critic": 1.0 / i, "play/5": 0.1 * i, "play/5_n": 3.0}
            for i in (1, 2, 3)
        ]
        lines.append({"step": 27, "cpu_seconds": 31.0, "evaluation/success_rate/5": 0.75})
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "bags_first.txt").write_text("8 of 8 episodes recorded\n5000 ticks of 8 episodes in 2 bags\n")
    outcome = {"success_rate": 0.5, "success_interval": [0.1, 0.9], "mean_return": 7.0, "failures": {}}
    (tmp_path / "evaluation.json").write_text(json.dumps({**outcome, "episodes": [1, 2]}))
    return tmp_path


def report(run: Path) -> list[str]:
    return write_report(run, Pipeline.read(run), {}).read_text().splitlines()


def test_rows_of_recordings_and_evaluations_say_what_came_of_them(run: Path) -> None:
    rows = {line.split(" | ")[0].strip("| "): line for line in report(run)}
    assert "| 5000 ticks of 8 episodes in 2 bags |" in rows["bags_first"]
    assert "| 50.0% of 2 levels solved |" in rows["evaluation"]


def test_curves_of_what_was_kept_are_called_so(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    titles = list[list[str]]()
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: titles.append([a.get_title() for a in figure.axes]))
    text = "\n".join(report(run))
    assert titles[0] == ["teacher (kept)", "planner"]
    assert "<summary>teacher (kept)</summary>" in text and "<summary>planner</summary>" in text


def test_each_training_has_a_section_with_what_it_measured_last_and_its_curves(run: Path) -> None:
    lines = report(run)
    planner = lines[lines.index("<details><summary>planner</summary>") :]
    section = planner[: planner.index("</details>")]
    for row in ("| evaluation/success_rate/5 | 0.75 |", "| loss/critic | 0.333 |", "| play/5 | 0.3 |", "| step | 27 |"):
        assert row in section
    assert not [line for line in section if "play/5_n" in line]
    picture = next(line for line in section if line.startswith("!["))
    assert (run / picture.partition("](")[2].rstrip(")")).stat().st_size > 0
    assert not [line for line in lines if "<summary>bags first" in line], "it has measured nothing"


def test_the_code_of_each_stage_is_named(run: Path) -> None:
    assert "  - by commit abc-dirty, torch 2.0, 1 of 2 cores" in report(run)
