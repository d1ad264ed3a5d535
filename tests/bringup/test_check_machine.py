"""The check that `make setup` begins with."""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "bringup" / "check_machine.py"


def check(*options, **environment):
    command = [sys.executable, SCRIPT, *options]
    return subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)


def test_a_machine_that_runs_this_suite_lacks_nothing():
    done = check()
    assert (done.returncode, done.stderr) == (0, "")


def test_its_help_says_what_it_does():
    done = check("--help")
    assert done.returncode == 0 and "Says in one line what this machine lacks" in done.stdout


def test_missing_compilers_are_named_in_one_line_with_their_packages(tmp_path):
    done = check(PATH=str(tmp_path))
    expected = "error: this machine lacks the C compiler gcc, the C++ compiler g++: apt-get install gcc g++\n"
    assert (done.returncode, done.stderr) == (2, expected)
