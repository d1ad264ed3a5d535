"""Programs end without a word where nobody reads what they print."""

import json
import os
import subprocess
import sys

import pytest

from mujoban_core.program import give_report

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
