"""The commands that benchmarks run, and how they end them."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from benchmarks import running


def test_a_command_is_interrupted_and_killed_where_it_does_not_heed_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "GIVE_UP", 0.3)
    statuses = []
    for handler in ("SIG_DFL", "SIG_IGN"):
        heed = f"signal.signal(signal.SIGINT, signal.{handler})"
        program = f"import signal, time; {heed}; print(flush=True); time.sleep(60)"
        with subprocess.Popen([sys.executable, "-S", "-c", program], stdout=subprocess.PIPE) as child:
            assert child.stdout is not None and child.stdout.readline()
            statuses.append(running.end(child))
    assert statuses == [-signal.SIGINT, -signal.SIGKILL]
