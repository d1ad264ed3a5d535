"""How soon each command ends when it is asked to, at any moment: `python -m benchmarks.interrupts --load 8`.

Every try starts a command, from a terminal or with pipes, interrupts it after a CPU time that is drawn anew, be it
still loading or at play, and checks what a user would: exit status, time, no process left, nothing left in shared
memory, a bag that can be read. After SIGKILL only the processes are looked for: the rest the next start clears away.
"""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from benchmarks.command import run_benchmark
from mujoban_core import children
from mujoban_core.signals import interruptible
from mujoban_msgs_py.bags import BagError, open_bag

ROOT: Final = Path(__file__).parents[1]
SHARED: Final = Path("/dev/shm")
LIMIT: Final = 2.0
"""Seconds within which a command has to end."""
GIVE_UP: Final = 60.0
"""Seconds after which a command that does not end is killed."""
_CPU_SECONDS: Final = (0.5, 15.0)
"""Of the command and its children, before the signal: all of start-up, and some of play."""
_SHORT: Final = ("--episodes", "1000")

_TICKS: Final = os.sysconf("SC_CLK_TCK")
MODES: Final[dict[str, tuple[str, ...]]] = {
    "lockstep": ("bringup/run_stack.py", "--headless", "--record", "BAG", *_SHORT),
    "terminal view": ("bringup/run_stack.py", "--record", "BAG", *_SHORT),
    "browser view": ("bringup/run_stack.py", "--view", "--headless", *_SHORT),
    "processes": ("bringup/run_stack.py", "--processes", "--headless", "--record", "BAG", *_SHORT),
    "real time": ("bringup/run_stack.py", "--realtime", "--headless", "--record", "BAG", *_SHORT),
    "record": ("bringup/record.py", "--out", "BAG", "--episodes", "1000", "--processes", "2"),
    "evaluate": ("bringup/evaluate.py", *_SHORT),
    "evaluate graph": ("bringup/evaluate.py", "--graph", *_SHORT),
}
"""Commands by mode; BAG stands for a folder that does not exist yet."""


@dataclass(frozen=True)
class Options:
    """What is tried."""

    modes: tuple[str, ...] = tuple(MODES)
    tries: int = 20
    """Of each mode."""
    load: int = 0
    """Processes that keep the machine busy meanwhile."""
    signals: tuple[str, ...] = ("SIGINT", "SIGTERM", "SIGHUP")
    """Taken in turns; SIGKILL as well."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Reject what does not exist."""
        unknown = sorted(set(self.modes) - MODES.keys())
        if unknown:
            raise ValueError(f"mode {unknown[0]!r}: expected some of {', '.join(MODES)}")


@dataclass(frozen=True)
class Try:
    """What came of one try."""

    seconds: float
    status: int
    faults: tuple[str, ...]


class Run:
    """A running command, in a terminal of its own or with pipes."""

    def __init__(self, command: list[str], terminal: bool) -> None:
        """Start the command."""
        self.terminal = terminal
        self._ours, theirs = pty.openpty() if terminal else os.pipe()
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=theirs if terminal else subprocess.DEVNULL, stdout=theirs, stderr=theirs,
            start_new_session=True, preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if terminal else None,
        )  # fmt: skip
        os.close(theirs)
        self._said = bytearray()
        self._hung_up = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def last_words(self) -> str:
        """The last line of what it has said."""
        return self._said.decode(errors="replace").strip().splitlines()[-1] if self._said.strip() else ""

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


def _cpu_seconds(pid: int) -> float:
    return sum(sum(map(int, _stat(p.pid)[11:13] or ())) for p in family(pid)) / _TICKS


def attempt(mode: str, number: signal.Signals, terminal: bool, cpu_seconds: float, folder: Path) -> Try:
    """Start a command, interrupt it after some CPU time, and look at what is left."""
    bag = folder / "bag"
    with Run([sys.executable, *(str(bag) if part == "BAG" else part for part in MODES[mode])], terminal) as run:
        return _interrupt(run, number, cpu_seconds, bag)


def _interrupt(run: Run, number: signal.Signals, cpu_seconds: float, bag: Path) -> Try:
    deadline = time.monotonic() + 20 * GIVE_UP
    while _cpu_seconds(run.process.pid) < cpu_seconds and run.process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    members = family(run.process.pid)
    shared = {name for member in members for name in _shared_memory(member)}
    start = time.monotonic()
    run.interrupt(number)
    faults = []
    try:
        status = run.process.wait(GIVE_UP)
    except subprocess.TimeoutExpired:
        faults.append("did not end")
        run.process.kill()
        status = run.process.wait()
    while any(member.lives for member in members) and time.monotonic() < start + LIMIT:
        time.sleep(0.02)
    seconds = time.monotonic() - start
    if seconds > LIMIT:
        faults.append(f"took {seconds:.1f} s, {cpu_seconds:.1f} CPU seconds after the start: {run.last_words}")
    faults += [f"left a process: {member.name}" for member in members if member.lives]
    expected = -number if number == signal.SIGKILL else 128 + number
    if status != expected:
        faults.append(f"status {status}: {run.last_words}")
    run.close()
    if number != signal.SIGKILL:
        faults += _look_at(bag)
        faults += [f"left {name}" for name in sorted(shared) if Path(name).exists() and not _is_used(name)]
    for member in members:
        if member.lives:
            os.kill(member.pid, signal.SIGKILL)
    return Try(seconds, status, tuple(faults))


def _shared_memory(process: Process) -> set[str]:
    """Return the files in shared memory that a process has mapped."""
    try:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
    except OSError:
        return set()
    return {line.split(maxsplit=5)[5] for line in maps.splitlines() if f" {SHARED}/" in line and "lttng" not in line}


def _is_used(name: str) -> bool:
    """Tell whether any process has mapped a file in shared memory."""
    alive = (Process.of(int(entry)) for entry in os.listdir("/proc") if entry.isdecimal())
    return any(name in _shared_memory(process) for process in alive if process is not None)


def _look_at(folder: Path) -> list[str]:
    """Return what is wrong with the bags at or below a folder."""
    faults = []
    for metadata in sorted({file.parent for file in folder.rglob("*.mcap")}):
        try:
            for _ in open_bag(metadata).messages():
                pass
        except (BagError, OSError) as error:
            faults.append(f"bag: {error}")
    return faults


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep the machine busy."""
    burners = [children.start([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        children.stop(burners)


def run(options: Options | None = None) -> dict[str, Any]:
    """Return, for each mode, how many tries were in order, the slowest one [s], and what went wrong."""
    chosen = options or Options()
    rng = np.random.default_rng(chosen.seed)
    report: dict[str, Any] = {}
    with busy(chosen.load), interruptible():
        for mode in chosen.modes:
            tries = []
            for index in range(chosen.tries):
                number = signal.Signals[chosen.signals[index % len(chosen.signals)]]
                terminal = mode == "terminal view" or index // len(chosen.signals) % 2 == 1
                with tempfile.TemporaryDirectory(prefix="mujoban-interrupts-") as folder:
                    tries.append(attempt(mode, number, terminal, rng.uniform(*_CPU_SECONDS), Path(folder)))
                for fault in tries[-1].faults:
                    print(f"{mode}, {number.name}, {'terminal' if terminal else 'pipe'}: {fault}", file=sys.stderr)
            seconds = sorted(t.seconds for t in tries)
            report[mode] = {
                "in_order": sum(not t.faults for t in tries),
                "tries": len(tries),
                "median_seconds": round(seconds[len(seconds) // 2], 2),
                "slowest_seconds": round(seconds[-1], 2),
            }
            print(f"{mode}: {report[mode]}", file=sys.stderr)
    return report


if __name__ == "__main__":
    run_benchmark("benchmarks.interrupts", Options, lambda chosen: {"options": asdict(chosen), **run(chosen)})
