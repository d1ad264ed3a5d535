"""Reports of evaluations and runs: what they say, when they are written, and where."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
from commands import ALL_ORACLES, UNSOLVABLE, run

from bringup import evaluate, reporting, run_stack, stack
from bringup.command import Stack
from bringup.graph import InProcess
from bringup.options import EpisodeOptions
from bringup.reporting import Reporting, played
from bringup.results import EpisodeResult
from mujoban_core.bodies import ANT
from mujoban_core.files import digest
from mujoban_core.signals import Interrupted
from mujoban_planner.deliberation import Deliberation
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.levels import Level, write_levels


def test_every_use_of_the_test_levels_is_kept_in_the_report(tmp_path):
    path = tmp_path / "report.json"
    for seed in (1000, 1001):
        options = ("--difficulty", 1, "--episodes", 2, "--seed", seed, "--time-limit", 3)
        assert run(evaluate, *options, *ALL_ORACLES, "--json", path) == 0
    uses = json.loads(path.read_text())["test_uses"]
    assert [use["seeds"] for use in uses] == [[1000, 1001], [1001, 1002]]
    assert all(use["weights"]["planner"] == "oracle" and "commit" in use for use in uses)
    assert [(use["played"]["difficulty"], use["played"]["time_limit"]) for use in uses] == [(1, 3), (1, 3)]


def test_a_report_on_levels_for_validation_names_the_code_that_played(tmp_path, monkeypatch):
    monkeypatch.setattr("bringup.reporting.commit_of", lambda file: f"commit of {Path(file).name}")
    path = tmp_path / "report.json"
    few = ["--difficulty", 1, "--episodes", 1, "--seed", 7_000_000, "--time-limit", 3, *ALL_ORACLES, "--json", path]
    assert run(evaluate, *few) == 0
    assert json.loads(path.read_text())["commit"] == "commit of reporting.py"


def test_a_report_says_what_was_played(tmp_path):
    path, levels = tmp_path / "report.json", tmp_path / "levels.txt"
    write_levels(levels, [Level.from_text(UNSOLVABLE)])
    game = {
        "difficulty": 1, "level_file": None, "level_file_sha256": None, "seed": 5_000_007, "time_limit": 3,
        "body": "ball", "world": "reference", "realtime": 0.0, "look_around": 7, "look_ahead": 0, "thinking": 0,
        "route": "in process", "batch": 3,
    }  # fmt: skip
    few = ["--episodes", 1, "--seed", 5_000_007, "--world", "reference", *ALL_ORACLES, "--json", path]
    third = ["--first-number", 3]
    assert run(evaluate, *few, "--difficulty", 1, "--time-limit", 3, "--look-around", 7, "--batch", 3, *third) == 0
    assert json.loads(path.read_text())["played"] == game
    assert json.loads(path.read_text())["first_number"] == 3
    through = ["--difficulty", 1, "--time-limit", 3, "--look-around", 7, "--graph"]
    assert run(evaluate, *few, *through) == 0
    assert json.loads(path.read_text())["played"] == {**game, "route": "graph", "batch": None}
    assert json.loads(path.read_text())["first_number"] == 1
    filed = {"difficulty": None, "level_file": str(levels), "level_file_sha256": digest(levels)}
    filed |= {"route": "graph", "batch": None}
    assert run(run_stack, "--headless", *few, "--levels", levels, "--time-limit", 3, "--realtime", 9) == 0
    assert json.loads(path.read_text())["played"] == {**game, **filed, "look_around": 0, "realtime": 9.0}
    searching = Stack(deliberation=Deliberation(look_ahead=400, certainty=0.8), body="ant")
    told = played(searching, Episodes(1, 0), EpisodeOptions(body="ant"))
    assert told["look_ahead"] == 400 and told["look_ahead_certainty"] == 0.8
    assert told["look_around"] == ANT.look_ticks and told["time_limit"] == 9600


def test_a_summary_on_the_terminal_names_lost_seeds_by_cause(capfd):
    options = ("--difficulty", 1, "--episodes", 2, "--seed", 1000, "--time-limit", 3)
    for command in (partial(run, evaluate), partial(run, run_stack, "--headless")):
        assert command(*options, *ALL_ORACLES) == 0
        captured = capfd.readouterr()
        rate, cause, privileged, *busy = captured.out.splitlines()
        assert all(line.startswith("simulator: repeated ticks: ") for line in busy)
        assert rate.startswith("solved 0 of 2 (0.0 %, 95 % interval 0.0 to 65.8 %), mean return ")
        assert cause == "lost by time limit: 2 (seeds 1000, 1001)"
        assert privileged.startswith("privileged, told the ground truth: estimator: oracle")
        assert "2 of 2 episodes ended" in captured.err
        assert captured.err.count("test levels were used, seeds 1000 to 1001, and this is written nowhere: --json") == 1


def test_an_interrupted_evaluation_reports_what_it_has(tmp_path):
    path = tmp_path / "report.json"
    command = [sys.executable, "bringup/evaluate.py", "--difficulty", "1", "--episodes", "400", "--batch", "2"]
    root = Path(run_stack.__file__).parents[1]
    process = subprocess.Popen(
        [*command, *ALL_ORACLES, "--time-limit", "20", "--json", str(path)], cwd=root, stderr=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    process.stderr.readline()  # a tenth is played
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err.strip().endswith("interrupted")
    content = json.loads(path.read_text())
    assert content["interrupted"] == 400 and 40 <= len(content["episodes"]) < 400
    assert "interrupted: 400 episodes were asked for" in out


@pytest.mark.parametrize("command", [(run_stack, "--headless"), (evaluate, "--graph")])
def test_an_interrupted_run_of_the_graph_reports_what_disturbed_it(tmp_path, capfd, monkeypatch, command):
    path, spin = tmp_path / "report.json", stack.spin

    def interrupted(*arguments):
        spin(*arguments)
        raise Interrupted(signal.SIGINT)

    monkeypatch.setattr(stack, "spin", interrupted)
    monkeypatch.setattr(InProcess, "counts", lambda graph: Counter({"monitor: foreign publishers": 1}))
    few = ["--difficulty", 1, "--episodes", 1, "--time-limit", 3, *ALL_ORACLES]
    assert run(*command, *few, "--json", path) == 130
    content = json.loads(path.read_text())
    assert content["interrupted"] == 1 and content["counts"] == {"monitor: foreign publishers": 1}
    assert "monitor: foreign publishers: 1" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--json", "no/folder/report.json"], "no such folder"),
        (["--json", "."], "is a folder"),
        (["--video", "no/film.mp4"], "no such folder"),
        (["--record", "."], "exists, expected a new folder"),
        (["--record", "/proc/bag"], "expected a place that can be written to"),
    ],
)
def test_places_for_output_are_checked_before_anything_is_played(capfd, monkeypatch, options, why):
    monkeypatch.setattr("bringup.command.Stack.identities", lambda stack: pytest.fail("went on"))
    assert run(run_stack, "--headless", *options) == 2
    err = capfd.readouterr().err.strip()
    assert f"error: {options[0]} {options[1]}: " in err and why in err and "\n" not in err


def test_a_report_does_not_take_the_place_of_the_record_of_weights(capfd, monkeypatch, tmp_path):
    monkeypatch.setattr("bringup.evaluate.evaluate", lambda *args, **options: pytest.fail("went on"))
    record, weights = tmp_path / "mine.json", tmp_path / "mine.safetensors"
    record.write_text("{}")
    weights.touch()
    assert run(evaluate, "--json", record) == 2 and record.read_text() == "{}"
    assert "is the record of mine.safetensors beside it, expected another name" in capfd.readouterr().err


def test_seeds_of_two_ranges_are_refused_before_anything_is_played(capfd, monkeypatch, tmp_path):
    for name in ("bringup.evaluate.evaluate", "bringup.stack.play"):
        monkeypatch.setattr(name, lambda *args, **options: pytest.fail("went on"))
    across = ["--seed", 4_999_999, "--episodes", 2, *ALL_ORACLES]
    for command in (partial(run, evaluate), partial(run, run_stack, "--headless")):
        assert command(*across) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert "error: seeds 4999999 to 5000000: expected all in one range (test 0 to 4999999; " in line
    levels = tmp_path / "levels.txt"
    write_levels(levels, [Level.from_text(UNSOLVABLE)])
    filed = Episodes(2, 4_999_999, level_file=levels)
    Reporting(None, {}, filed, played(Stack(), filed, EpisodeOptions()))  # seeds say nothing of a file's levels


def test_what_was_played_before_an_error_is_reported_and_that_test_levels_were_used(tmp_path, capfd):
    result = EpisodeResult(1000, True, 11.0, 5, 1, 0, 0, None)
    episodes = Episodes(4, 1000)
    reporting = Reporting(tmp_path / "report.json", {}, episodes, played(Stack(), episodes, EpisodeOptions()))
    with pytest.raises(OSError, match="disk"), reporting:
        reporting.results = [result]
        raise OSError("the disk is full")
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["interrupted"] == 4 and content["test_uses"][0]["seeds"] == [1000, 1000]
    told = capfd.readouterr()
    assert told.out.count("solved 1 of 1") == 1 and "written nowhere" not in told.err


def test_a_report_is_written_though_nobody_reads_its_summary_any_more(tmp_path, monkeypatch):
    episodes = Episodes(1, 1000)
    reporting = Reporting(tmp_path / "report.json", {}, episodes, played(Stack(), episodes, EpisodeOptions()))
    monkeypatch.setattr(sys.stdout, "write", Mock(side_effect=BrokenPipeError))
    with pytest.raises(BrokenPipeError):
        reporting.finish([EpisodeResult(1000, True, 11.0, 5, 1, 0, 0, None)])
    assert json.loads((tmp_path / "report.json").read_text())["test_uses"][0]["seeds"] == [1000, 1000]


def test_an_interruption_at_the_end_waits_for_the_report(tmp_path, monkeypatch, capfd):
    def late(content, path, keep=reporting.keep_report):
        os.kill(os.getpid(), signal.SIGINT)
        keep(content, path)

    monkeypatch.setattr(reporting, "keep_report", late)
    path, episodes = tmp_path / "report.json", Episodes(1, 1000)
    with pytest.raises(KeyboardInterrupt):
        Reporting(path, {}, episodes, played(Stack(), episodes, EpisodeOptions())).finish(
            [EpisodeResult(1000, True, 11.0, 5, 1, 0, 0, None)]
        )
    assert json.loads(path.read_text())["success_rate"] == 1.0 and "interrupted" not in json.loads(path.read_text())
    assert "solved 1 of 1" in capfd.readouterr().out


def test_of_a_file_only_the_levels_that_are_played_are_looked_through(tmp_path, monkeypatch, capsys):
    levels = tmp_path / "levels.txt"
    write_levels(levels, [generate_level(1, 1000), Level.from_text(UNSOLVABLE), generate_level(1, 1001)])
    EpisodeOptions(levels=levels, episodes=1).make(3)
    assert not capsys.readouterr().err
    EpisodeOptions(levels=levels, episodes=2).make(0)
    assert "level 1 of" in capsys.readouterr().err


def test_a_report_goes_through_a_device_and_never_replaces_it(tmp_path, capfd):
    few = ["--difficulty", 1, "--episodes", 1, "--time-limit", 3, *ALL_ORACLES]
    null = tmp_path / "null"
    null.symlink_to("/dev/null")
    assert run(evaluate, *few, "--json", null) == 0 and run(evaluate, *few, "--json", "/dev/null") == 0
    assert null.is_symlink() and Path("/dev/null").is_char_device()
    assert run(evaluate, *few, "--json", "/dev/full") == 2
    assert capfd.readouterr().err.splitlines()[-1] == "command: error: /dev/full: No space left on device"
