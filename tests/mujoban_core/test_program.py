"""Programs end quietly where nobody reads on, and say in one line what is wrong and what was expected."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mujoban_core.program import exit_status, read_changes, read_options
from mujoban_core.reports import give_report

PROGRAM = """
from dataclasses import dataclass
from mujoban_core.program import read_options, run_command

@dataclass
class Options:
    lines: int = 100_000

def main():
    for number in range(read_options(Options, None, "counts").lines):
        print(number)
    return 0

run_command("counts", main)
"""


@pytest.mark.parametrize("arguments", [["--help"], [], ["--lines", "1"]])
def test_a_reader_that_leaves_early_ends_a_program_quietly(arguments):
    ours, theirs = os.pipe()
    os.close(ours)
    try:
        command = [sys.executable, "-c", PROGRAM, *arguments]
        ended = subprocess.run(command, stdout=theirs, stderr=subprocess.PIPE, text=True, timeout=60)
    finally:
        os.close(theirs)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_report_is_printed_or_written_but_not_both(tmp_path, capsys):
    give_report({"n": 3}, None)
    printed = capsys.readouterr().out
    give_report({"n": 3}, tmp_path / "report.json")
    assert json.loads(printed) == {"n": 3} and (tmp_path / "report.json").read_text() == printed
    assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("missing.txt", "missing.txt: No such file or directory, expected one that exists"),
        (".", ".: Is a directory, expected a file"),
        ("file/below", "file/below: Not a directory, expected a folder"),
    ],
)
def test_what_the_system_says_of_a_file_comes_with_what_was_expected(tmp_path, monkeypatch, capsys, path, said):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert exit_status("program", lambda: len(Path(path).read_text())) == 2
    assert capsys.readouterr().err == f"program: error: {said}\n"


def test_a_folder_in_whose_place_there_is_a_file_is_named(tmp_path, capsys):
    (tmp_path / "run").touch()
    assert exit_status("program", lambda: bool((tmp_path / "run").mkdir(parents=True, exist_ok=True))) == 2
    said = f"program: error: {tmp_path / 'run'}: File exists, expected a folder, or a name that is free\n"
    assert capsys.readouterr().err == said


def test_what_an_option_of_a_subcommand_rejects_is_said_in_its_own_words():
    @dataclass
    class Settings:
        reuse: float = 1.0

        def __post_init__(self):
            if self.reuse <= 0:
                raise ValueError(f"reuse {self.reuse}: expected more than 0")

    @dataclass
    class Options:
        settings: Settings = field(default_factory=Settings)

    with pytest.raises(ValueError, match=r"^reuse 0\.0: expected more than 0$"):
        read_options({"one": Options, "two": Options}, ["one", "--settings.reuse", "0"], "program")


def test_an_unknown_subcommand_is_told_all_that_there_are():
    @dataclass
    class Options:
        steps: int = 8

    with pytest.raises(ValueError, match=r"^three: expected one of one, two$"):
        read_options({"one": Options, "two": Options}, ["three", "--steps", "4"], "program")


def test_what_all_options_together_reject_begins_with_the_option():
    @dataclass
    class Options:
        hours: float = 1.0

        def __post_init__(self):
            if self.hours <= 0:
                raise ValueError(f"--hours {self.hours}: expected more than 0")

    with pytest.raises(ValueError, match=r"^--hours 0\.0: expected more than 0$"):
        read_options(Options, ["--hours", "0"], "program")


def test_options_in_the_value_of_another_change_settings_and_fail_without_names_of_classes():
    @dataclass
    class Inner:
        steps: int = 8

    @dataclass
    class Settings:
        reuse: float = 1.0
        inner: Inner = field(default_factory=Inner)

        def __post_init__(self):
            if self.reuse <= 0:
                raise ValueError(f"reuse is {self.reuse}: expected more than 0")

    settings = Settings(2.0)
    assert read_changes(settings, ["--steps", "4"], "others") == Settings(2.0, Inner(4)) != settings
    for words, said in (
        (["--reuse", "0"], r"^reuse is 0\.0: expected more than 0$"),
        (["--bogus"], "^unrecognized options: --bogus, expected others$"),
        (["--help"], "^unrecognized options: --help, expected others$"),
    ):
        with pytest.raises(ValueError, match=said):
            read_changes(settings, words, "others")


def test_an_option_of_many_subcommands_is_proposed_once():
    @dataclass
    class Options:
        initial: float = 0.0

    with pytest.raises(ValueError, match=r"--initail.*expected --initial FLOAT$"):
        read_options({"one": Options, "two": Options}, ["one", "--initail", "1"], "program")


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("Could not allocate memory"), ImportError("x.so: failed to map segment")]
)
def test_a_machine_without_memory_is_one_line_and_a_fault_of_ours_a_traceback(capsys, error):
    def fail(error):
        raise error

    assert exit_status("program", lambda: fail(error)) == 2
    said = capsys.readouterr().err
    assert said.startswith("program: error: out of memory (") and said.count("\n") == 1
    with pytest.raises(RuntimeError, match="ours"):
        exit_status("program", lambda: fail(RuntimeError("ours")))
