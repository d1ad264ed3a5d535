"""What the stages of a run from nothing are told."""

from __future__ import annotations

from pathlib import Path

import pytest

import mujoban_controller.train
import mujoban_estimator.train
from bringup.train_all import PRODUCTS, Options, stages
from mujoban_core.program import read_options


def commands(options: Options) -> dict[str, tuple[str, ...]]:
    return {stage.name: stage.command for stage in stages(options)}


def finished(folder: Path) -> Path:
    """Make what a finished run leaves; stages look at names alone."""
    for product in PRODUCTS.values():
        path = folder / product
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def test_a_run_begins_from_nothing(tmp_path: Path) -> None:
    for name, command in commands(Options(run=tmp_path)).items():
        begun = {option for option in ("--initial", "--init", "--start") if option in command}
        # What a later stage begins with was made by an earlier one of the same run.
        assert all(command[command.index(option) + 1].startswith(str(tmp_path)) for option in begun), name
        assert "--initial" not in begun or name == "controller_mpo"


def test_a_continued_run_takes_every_module_from_the_one_before(tmp_path: Path) -> None:
    before = finished(tmp_path / "before")
    found = commands(Options(run=tmp_path / "run", before=before))
    for name, option, product in (
        ("teacher", "--initial", "teacher"), ("controller_distil", "--initial", "controller"),
        ("planner", "--init", "whole"),
    ):  # fmt: skip
        assert found[name][found[name].index(option) + 1] == str(before / PRODUCTS[product])
    first = found["estimator_first"]
    assert first[first.index("--start") + 1] == str((before / PRODUCTS["estimator"]).parent)
    assert str(before / PRODUCTS["first"]) in first and str(before / PRODUCTS["second"]) in found["estimator_second"]


def test_continuing_what_is_not_finished_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--continue .* lacks .*, expected the directory of a finished run"):
        Options(run=tmp_path / "run", before=tmp_path)


@pytest.mark.parametrize("continued", [False, True])
def test_trainers_know_the_options_that_they_are_given(tmp_path: Path, continued: bool) -> None:
    before = finished(tmp_path / "before") if continued else None
    programs = {
        "mujoban_controller.train": mujoban_controller.train.Options,
        "mujoban_estimator.train": mujoban_estimator.train.Options,
    }
    for name, command in commands(Options(run=tmp_path / "run", before=before)).items():
        if command[1] in programs:
            options = read_options(programs[command[1]], command[2:], name)
            assert options.run == tmp_path / "run" / name
