"""How soon each command ends when it is asked to, at any moment: `python -m benchmarks.interrupts --load 8`.

Every try starts a command, from a terminal or with pipes, interrupts it after a CPU time that is drawn anew, be it
still loading or at play, and checks what a user would: exit status, time, no process left, nothing left in shared
memory, a bag that can be read. After SIGKILL only the processes are looked for: the rest the next start clears away.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil

from benchmarks.command import run_benchmark
from benchmarks.running import GIVE_UP, Run, cpu_seconds, family, lives, name_of
from mujoban_core.signals import interruptible
from mujoban_msgs_py.bags import BagError, open_bag

SHARED: Final = Path("/dev/shm")
LIMIT: Final = 2.0
"""Seconds within which a command has to end."""
_CPU_SECONDS: Final = (0.5, 15.0)
"""Of the command and its children, before the signal: all of start-up, and some of play."""
_SHORT: Final = ("--episodes", "1000")

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


def attempt(mode: str, number: signal.Signals, terminal: bool, at: float, folder: Path) -> Try:
    """Start a command, interrupt it after some CPU time, and look at what is left."""
    bag = folder / "bag"
    with Run([sys.executable, *(str(bag) if part == "BAG" else part for part in MODES[mode])], terminal) as run:
        return _interrupt(run, number, at, bag)


def _interrupt(run: Run, number: signal.Signals, at: float, bag: Path) -> Try:
    deadline = time.monotonic() + 20 * GIVE_UP
    while cpu_seconds(run.process.pid) < at and run.process.poll() is None and time.monotonic() < deadline:
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
    while any(map(lives, members)) and time.monotonic() < start + LIMIT:
        time.sleep(0.02)
    seconds = time.monotonic() - start
    if seconds > LIMIT:
        faults.append(f"took {seconds:.1f} s, {at:.1f} CPU seconds after the start: {run.last_words}")
    faults += [f"left a process: {name_of(member)}" for member in members if lives(member)]
    # While a program is still being imported, the signal itself ends it; shells say 128 + number in both cases.
    if status not in (-number, 128 + number):
        faults.append(f"status {status}: {run.last_words}")
    run.close()
    if number != signal.SIGKILL:
        faults += _look_at(bag)
        faults += [f"left {name}" for name in sorted(shared) if Path(name).exists() and not _is_used(name)]
    for member in members:
        if lives(member):
            os.kill(member.pid, signal.SIGKILL)
    return Try(seconds, status, tuple(faults))


def _shared_memory(process: psutil.Process) -> set[str]:
    """Return the files in shared memory that a process has mapped."""
    try:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
    except OSError:
        return set()
    return {line.split(maxsplit=5)[5] for line in maps.splitlines() if f" {SHARED}/" in line and "lttng" not in line}


def _is_used(name: str) -> bool:
    """Tell whether any process has mapped a file in shared memory."""
    return any(name in _shared_memory(process) for process in psutil.process_iter())


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
    """Keep the machine busy, as from so many terminals: Linux deals time out to sessions first (`sched_autogroup`)."""
    program = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100_000))"
    command = [sys.executable, "-S", "-c", program]
    burners = [subprocess.Popen(command, start_new_session=True) for _ in range(processes)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


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
