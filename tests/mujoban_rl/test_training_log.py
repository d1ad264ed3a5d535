import errno
import io
import json
import re
import sys

import pytest
import torch
from rich.console import Console

from mujoban_rl.metrics import read_metrics
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.training_log import TrainingLog

NUMBERS = {"loss/critic": 0.97656, "loss/policy": -1120.4, "solved": 0.5, "return": -7.25, "steps": 1234567.0, "n": 1}


def test_log_keeps_a_readable_learning_curve(tmp_path):
    run = RunDirectory(tmp_path, {})
    with TrainingLog(run, total=2) as log:
        log.scalars(1, {"loss": torch.tensor(0.5), "bad": float("nan")})
    line = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert (line["step"], line["loss"], line["bad"]) == (1, 0.5, None)


def test_a_line_that_broke_off_on_a_full_disk_is_not_read_and_not_written_behind(tmp_path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 1}\n{"step": 2, "lo')
    assert read_metrics(tmp_path) == [{"step": 1}]
    with TrainingLog(RunDirectory(tmp_path, {})) as log:
        log.scalars(3, {"loss": 0.5})
    assert [line["step"] for line in read_metrics(tmp_path)] == [1, 3]


@pytest.mark.parametrize("total", [5_000_000, None])
def test_a_terminal_of_60_columns_shows_a_bar_and_no_number_cut_off(tmp_path, total):
    console = Console(file=io.StringIO(), force_terminal=True, width=60, color_system=None)
    with TrainingLog(RunDirectory(tmp_path, {}), total=total, initial=1_234_000, unit="sample", console=console) as log:
        log.advance(567)
        log.scalars(1_234_567, NUMBERS)
    bar, numbers = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue()).rstrip().splitlines()[-2:]
    assert bar.startswith("1,234,567 of 5,000,000 samples ━" if total else "1,234,567 samples ━")
    assert len(bar) <= 60 and "…" not in bar
    assert numbers == "critic 0.977, policy -1,120, solved 0.5, return -7.25"


@pytest.mark.parametrize("error", [BrokenPipeError(), OSError(errno.EIO, "Input/output error")])
def test_a_run_goes_on_and_is_logged_when_nobody_can_read_its_progress_any_more(tmp_path, monkeypatch, error):
    class Gone(io.StringIO):
        def write(self, text=""):
            raise error

        flush = write

    monkeypatch.setattr(sys, "stderr", Gone())
    with TrainingLog(RunDirectory(tmp_path, {}), line_seconds=0.0) as log:
        for step in range(3):
            log.scalars(step, NUMBERS)
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 3


def test_a_pipe_gets_plain_lines_now_and_then_and_one_at_the_end(tmp_path):
    def lines(**options):
        console = Console(file=io.StringIO(), width=60)
        with TrainingLog(RunDirectory(tmp_path, {}), total=300, unit="sample", console=console, **options) as log:
            for step in range(3):
                log.advance(100)
                log.scalars(step, NUMBERS)
            log.scalars(300, {"evaluation/solved": 0.9}, "300 samples: solved 0.9")
            log.scalars(300, NUMBERS)
        return console.file.getvalue().splitlines()

    first, evaluation, last = lines()
    shown = "critic 0.977, policy -1,120, solved 0.5, return -7.25, steps 1,234,567"
    assert re.fullmatch(rf"100 of 300 samples, 0:00:0\d: {shown}", first)
    assert evaluation == "300 samples: solved 0.9"
    assert re.fullmatch(rf"300 of 300 samples, 0:00:0\d: {shown}", last)
    assert len(lines(line_seconds=0.0)) == 5
