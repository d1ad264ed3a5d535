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
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

import psutil

from mujoban_msgs_py.runtime.discovery import DOMAIN

ROOT: Final = Path(__file__).parents[1]
GIVE_UP: Final = 60.0
"""Seconds after which a command that does not end is killed."""
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
            preexec_fn=self._prepare,
        )  # fmt: skip
        os.close(theirs)
        self._said = bytearray()
        self._hung_up = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _prepare(self) -> None:
        """In the child: take the terminal, and hear hang-ups and Ctrl-C, which nohup and `&` have it ignore."""
        for number in (signal.SIGHUP, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        if self.terminal:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

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


def end(child: subprocess.Popen[bytes]) -> int:
    """Interrupt a command and return its status; one that has not ended after `GIVE_UP` is killed."""
    child.send_signal(signal.SIGINT)
    try:
        return child.wait(GIVE_UP)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def take_domain() -> None:
    """Name a ROS domain of its own to this process, and so to the run that it starts and looks at."""
    os.environ[DOMAIN] = str(60 + os.getpid() % 40)


def lives(process: psutil.Process) -> bool:
    """Return whether a process has not ended."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def name_of(process: psutil.Process) -> str:
    """Return the command line of a process, shortened."""
    try:
        return " ".join(process.cmdline())[-60:]
    except psutil.Error:
        return str(process.pid)


def family(pid: int) -> list[psutil.Process]:
    """Return a process and all that descend from it, of those that live."""
    try:
        process = psutil.Process(pid)
        return [member for member in (process, *process.children(recursive=True)) if lives(member)]
    except psutil.NoSuchProcess:
        return []


def cpu_seconds(pid: int) -> float:
    """Return the CPU time [s] of a process and all that descend from it, of ended ones if they were waited for."""
    total = 0.0
    for member in family(pid):
        with suppress(psutil.NoSuchProcess):
            times = member.cpu_times()
            total += times.user + times.system + times.children_user + times.children_system
    return total


def megabytes(pid: int) -> int:
    """Return the resident memory of a process; 0 if it has ended."""
    try:
        return psutil.Process(pid).memory_info().rss >> 20
    except psutil.NoSuchProcess:
        return 0
