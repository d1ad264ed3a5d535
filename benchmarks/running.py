"""Commands as a user runs them, in a terminal or with pipes, and the processes that they start."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import termios
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

ROOT: Final = Path(__file__).parents[1]
GIVE_UP: Final = 60.0
"""Seconds after which a command that does not end is killed."""
_TICKS: Final = os.sysconf("SC_CLK_TCK")
_CONTROL: Final = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07]*\x07|.)|\r")


class Run:
    """A running command, in a terminal of its own or with pipes."""

    def __init__(
        self, command: Sequence[str], terminal: bool, folder: Path = ROOT, environment: Mapping[str, str] | None = None
    ) -> None:
        """Start the command in a folder, with variables on top of this process's environment."""
        self.terminal = terminal
        self._ours, theirs = pty.openpty() if terminal else os.pipe()
        self.process = subprocess.Popen(
            command, cwd=folder, env={**os.environ, **(environment or {})},
            stdin=theirs if terminal else subprocess.DEVNULL, stdout=theirs, stderr=theirs, start_new_session=True,
            preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if terminal else None,
        )  # fmt: skip
        os.close(theirs)
        self._said = bytearray()
        self._hung_up = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def said(self) -> str:
        """What it has said, without what moves the cursor and colours the text."""
        return _CONTROL.sub("", self._said.decode(errors="replace")).strip()

    @property
    def last_words(self) -> str:
        """The last line of what it has said."""
        return self.said.splitlines()[-1] if self.said else ""

    def _read(self) -> None:
        while not self._hung_up.is_set():
            if not select.select([self._ours], [], [], 0.05)[0]:
                continue
            try:
                data = os.read(self._ours, 65536)
            except OSError:  # a terminal whose last program has left
                return
            if not data:
                return
            self._said += data

    def interrupt(self, number: signal.Signals) -> None:
        """Press Ctrl-C or close the terminal, where there is one; else send the signal."""
        if self.terminal and number == signal.SIGINT:
            os.write(self._ours, b"\x03")
        elif self.terminal and number == signal.SIGHUP:
            self.close()
        else:
            self.process.send_signal(number)

    def __enter__(self) -> Self:
        """Return the run."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Kill the command if it has not ended."""
        self.process.kill()
        self.process.wait()
        self.close()

    def close(self) -> None:
        """Close the terminal or the pipe."""
        if not self._hung_up.is_set():
            self._hung_up.set()
            self._reader.join()
            os.close(self._ours)


@dataclass(frozen=True)
class Process:
    """A process, told from a later one of the same number by its start."""

    pid: int
    start: str

    @classmethod
    def of(cls, pid: int) -> Process | None:
        """Return a process that lives, or None."""
        fields = _stat(pid)
        return None if not fields or fields[0] == "Z" else cls(pid, fields[19])

    @property
    def lives(self) -> bool:
        """Whether it has not ended."""
        return Process.of(self.pid) == self

    @property
    def name(self) -> str:
        """Its command line, shortened."""
        try:
            return Path(f"/proc/{self.pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()[-60:]
        except OSError:
            return str(self.pid)


def _stat(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat from the state on; none if there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def family(pid: int) -> list[Process]:
    """Return a process and all that descend from it."""
    process = Process.of(pid)
    if process is None:
        return []
    found = [process]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            offspring = task.read_text().split()
        except OSError:
            continue
        found += [member for child in offspring for member in family(int(child))]
    return found


def cpu_seconds(pid: int) -> float:
    """Return the CPU time [s] of a process and all that descend from it, of ended ones if they were waited for."""
    return sum(sum(map(int, _stat(p.pid)[11:15] or ())) for p in family(pid)) / _TICKS
