"""Run stages, each a command of its own, in the order in which they need each other; stop and go on at any point.

What is done stands in `pipeline.json` of the run's directory: for every stage its command, the code and the machine
that it ran with, the digests of what it came from and of what it made, and the time that it took, by the clock and of
the processor. A stage that was stopped is started again with the same command: every trainer of this project resumes
from its directory. So is one whose products are gone where another needs them; products that are others than were made
are refused there.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mujoban_core import children
from mujoban_core.commit import commit_of
from mujoban_core.files import alone, brief, digest, write_atomically
from mujoban_core.signals import StopSignal

_PERIOD = 0.2
"""Seconds between two looks at the commands that run."""
_GRACE = 90.0
"""Seconds that a command has, after SIGTERM, to write its checkpoint."""
_TAIL = 2000
"""Characters of a failed command's log that the error shows."""
_LATE = 0.1
"""Of the time that a stage has taken so far, what is expected of it at least until it ends."""


class PipelineError(ValueError):
    """A stage failed, or the stages cannot be run in any order."""


@dataclass(frozen=True)
class Stage:
    """A command with what it needs and makes."""

    name: str
    command: tuple[str, ...]
    """Arguments of the Python interpreter."""
    products: tuple[Path, ...]
    """Files or folders that exist when it is done."""
    needs: tuple[str, ...] = ()
    """Names of the stages whose products it takes."""
    seconds: float = 60.0
    """How long it is expected to take; for the progress that is shown."""
    cores: int = 1
    resumes: bool = True
    """Whether the command goes on where it was stopped; if not, what it had made is removed before it starts again."""
    sources: tuple[Path, ...] = ()
    """Files or folders from elsewhere that it takes."""


@dataclass
class Entry:
    """What the pipeline knows of a stage; kept in `pipeline.json`."""

    command: list[str] = field(default_factory=list)
    done: bool = False
    seconds: float = 0.0
    """Wall-clock, of all its starts together."""
    cpu_seconds: float = 0.0
    """Of its processes that have ended; what stages that were stopped together used is divided by their wall-clock."""
    spans: list[list[float]] = field(default_factory=list)
    """When each start began and ended, in seconds since 1970."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 digests of the products of the stages that it needed, and of its sources."""
    outputs: dict[str, str] = field(default_factory=dict)
    ran_with: list[dict[str, Any]] = field(default_factory=list)
    """Code and machine: `commit`, `torch`, `cores` that the stage was given of the `machine_cores`; a further entry
    where a start had others than the one before."""


class Pipeline:
    """Stages of one run directory."""

    def __init__(self, directory: Path, stages: Sequence[Stage], *, cores: int = 2) -> None:
        """Open the run, taking over what was done before.

        Args:
            directory: The run's directory; logs go to `logs/STAGE.txt` in it.
            stages: All stages.
            cores: Stages run side by side while their cores do not add up to more; each runs alone if it wants more.

        Raises:
            PipelineError: If a need names no stage before it, a stage that is done had another command, or the record
                of the run is damaged.
        """
        self.directory, self.stages, self.cores = directory, tuple(stages), cores
        self._file = directory / "pipeline.json"
        stored = _stored(self._file)
        self.entries = {s.name: stored.get(s.name, Entry()) for s in self.stages}
        known: set[str] = set()
        for stage in self.stages:
            if missing := [need for need in stage.needs if need not in known]:
                raise PipelineError(f"stage {stage.name} needs {', '.join(missing)}: expected stages before it")
            known.add(stage.name)
            self._check_command(stage)
        self._running: dict[str, tuple[subprocess.Popen[bytes], float]] = {}
        self._cpu_seconds = _spent_by_children()

    @classmethod
    def read(cls, directory: Path) -> Pipeline:
        """Return a run as its record has it, which knows no needs.

        Raises:
            PipelineError: If the record is damaged.
        """
        stored = _stored(directory / "pipeline.json")
        return cls(directory, [Stage(name, tuple(entry.command), ()) for name, entry in stored.items()])

    def _check_command(self, stage: Stage) -> None:
        entry = self.entries[stage.name]
        if entry.done and entry.command != list(stage.command):
            raise PipelineError(
                f"{self.directory}: stage {stage.name} ran as {' '.join(entry.command)}, not as "
                f"{' '.join(stage.command)}; expected the options of before, or another directory"
            )

    @property
    def done(self) -> bool:
        """Whether every stage is done."""
        return all(entry.done for entry in self.entries.values())

    def elapsed(self, name: str) -> float:
        """Return the seconds that a stage has taken so far, in all its starts."""
        started = self._running.get(name)
        return self.entries[name].seconds + (time.monotonic() - started[1] if started else 0.0)

    def running(self) -> list[str]:
        """Return the names of the stages that run now."""
        return list(self._running)

    def seconds(self) -> float:
        """Return the wall-clock in which at least one of the stages that have ended ran."""
        total, until = 0.0, 0.0
        for start, end in sorted(span for entry in self.entries.values() for span in entry.spans):
            total += max(0.0, end - max(start, until))
            until = max(until, end)
        return total

    def remaining(self) -> float:
        """Return the seconds until all is done, if every stage takes as long as is expected of it.

        One that has taken longer, as budgets of the processor do on a busy machine, is expected to take on for a part
        of what it has taken: the end that is told has never passed.
        """
        done = {name for name, entry in self.entries.items() if entry.done}
        taken = {s.name: self.elapsed(s.name) for s in self.stages if s.name not in done}
        left = {s.name: max(s.seconds - taken[s.name], _LATE * taken[s.name]) for s in self.stages if s.name in taken}
        running, total = self.running(), 0.0
        while left:
            running += [s.name for s in self._ready(self.entries.keys() - left, running)]
            first = min(running, key=lambda name: left[name])
            step = left[first]
            left = {name: seconds - step * (name in running) for name, seconds in left.items() if name != first}
            running.remove(first)
            total += step
        return total

    def run(self, on_tick: Callable[[Pipeline], None] | None = None) -> None:
        """Run what is not done yet.

        Args:
            on_tick: Called several times a second, to show progress.

        Raises:
            PipelineError: If a command fails or does not make what it should; the others are stopped. Or if another
                process runs the stages of this directory, what a stage needs was changed since it was made, or what it
                would make anew is there already and not of this run.
            Interrupted: If a signal came; the commands were stopped and have kept their checkpoints.
        """
        with self.alone(), StopSignal() as stop:
            self._redo_what_is_gone()
            self._check_what_is_needed()
            self._check_what_would_be_removed()
            try:
                while not self.done:
                    stop.check()
                    self._start_ready()
                    self._reap()
                    if on_tick is not None:
                        on_tick(self)
                    time.sleep(_PERIOD)
            finally:
                self._stop_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from running the stages of this run; the system frees it however this one ends.

        Raises:
            InUseError: If another process runs them.
        """
        with alone(self.directory):
            yield

    def _redo_what_is_gone(self) -> None:
        """Take those stages for not done whose products are gone and wanted by one that is not done."""
        wanted: set[str] = set()
        for stage in reversed(self.stages):
            entry = self.entries[stage.name]
            if stage.name in wanted and not all(path.exists() for path in stage.products):
                entry.done = False
            if not entry.done:
                wanted.update(stage.needs)

    def _check_what_is_needed(self) -> None:
        """Check that products which stages are yet to take are those that were made; what nobody takes may change."""
        wanted = {need for stage in self.stages if not self.entries[stage.name].done for need in stage.needs}
        for stage in self.stages:
            made = self.entries[stage.name]
            if stage.name not in wanted or not made.done:
                continue
            for path in stage.products:
                expected = made.outputs.get(_name(path, self.directory))
                if expected is not None and (found := digest(path)) != expected:
                    raise PipelineError(
                        f"{path}: was changed since stage {stage.name} made it: SHA-256 is {brief(found)}, "
                        f"expected {brief(expected)}; or remove it, and it is made again"
                    )

    def _check_what_would_be_removed(self) -> None:
        """Check that what a stage removes before it starts was made by itself, and not by somebody else."""
        for stage in self.stages:
            if stage.resumes or self.entries[stage.name].ran_with:
                continue
            if there := [path for path in stage.products if path.exists()]:
                raise PipelineError(
                    f"{there[0]}: is there already, but not of this run, whose stage {stage.name} makes it anew; "
                    "expected none: move it away, or remove it"
                )

    def _start_ready(self) -> None:
        done = {name for name, entry in self.entries.items() if entry.done}
        for stage in self._ready(done, self.running()):
            self._start(stage)

    def _ready(self, done: Collection[str], running: Collection[str]) -> list[Stage]:
        """Return the stages to start beside those that run, when some are done."""
        used = sum(s.cores for s in self.stages if s.name in running)
        ready = []
        for stage in self.stages:
            if stage.name in done or stage.name in running or not all(need in done for need in stage.needs):
                continue
            if used and used + stage.cores > self.cores:
                continue
            ready.append(stage)
            used += stage.cores
        return ready

    def _start(self, stage: Stage) -> None:
        entry = self.entries[stage.name]
        entry.command = list(stage.command)
        entry.inputs = {k: v for need in stage.needs for k, v in self.entries[need].outputs.items()}
        entry.inputs |= {_name(p, self.directory): digest(p) for p in stage.sources}
        if (now := _ran_with(stage)) not in entry.ran_with[-1:]:
            entry.ran_with.append(now)
        self._save()
        if not stage.resumes:
            _remove(stage.products)
        log = self._log(stage.name)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as output:
            process = children.start(
                [sys.executable, *stage.command], {"OMP_NUM_THREADS": str(stage.cores)}, output
            )
        self._running[stage.name] = (process, time.monotonic())

    def _reap(self) -> None:
        """Note stages that have ended, all of them before one that failed is complained of."""
        failed: PipelineError | None = None
        for stage in self.stages:
            if stage.name not in self._running or (code := self._running[stage.name][0].poll()) is None:
                continue
            self._finish([stage.name])
            try:
                self._take(stage, code)
            except PipelineError as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def _take(self, stage: Stage, code: int) -> None:
        """Take over what a stage has made whose command ended with status `code`."""
        if code != 0:
            log = self._log(stage.name)
            tail = log.read_text(errors="replace")[-_TAIL:]
            raise PipelineError(f"stage {stage.name} ended with {code}; its log {log} ends: {tail}")
        if missing := [str(p) for p in stage.products if not p.exists()]:
            raise PipelineError(f"stage {stage.name} ended without {', '.join(missing)}")
        entry = self.entries[stage.name]
        entry.outputs = {_name(p, self.directory): digest(p) for p in stage.products}
        entry.done = True
        self._save()

    def _finish(self, names: Sequence[str]) -> None:
        """Count the time of stages whose processes have just ended."""
        now, spent = time.time(), _spent_by_children()
        bits = {name: self.elapsed(name) - self.entries[name].seconds for name in names}
        for name, seconds in bits.items():
            entry = self.entries[name]
            entry.seconds += seconds
            entry.cpu_seconds += (spent - self._cpu_seconds) * seconds / sum(bits.values())
            entry.spans.append([now - seconds, now])
            del self._running[name]
        self._cpu_seconds = spent
        self._save()

    def _stop_all(self) -> None:
        try:
            with suppress(PipelineError):  # it is another error, or a signal, that the run ends with
                self._reap()  # what has ended well by now is done: a stage that does not resume would be made anew
        finally:
            if self._running:
                children.stop([process for process, _ in self._running.values()], _GRACE)
                self._finish(self.running())

    def _log(self, name: str) -> Path:
        return self.directory / "logs" / f"{name}.txt"

    def _save(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        content: Mapping[str, Any] = {name: asdict(entry) for name, entry in self.entries.items() if entry.command}
        write_atomically(self._file, (json.dumps(content, indent=2) + "\n").encode())


def _ran_with(stage: Stage) -> dict[str, Any]:
    """Return what `Entry.ran_with` keeps of a start."""
    return {
        "commit": commit_of(Path(__file__).resolve()), "torch": version("torch"), "cores": stage.cores,
        "machine_cores": len(os.sched_getaffinity(0)),
    }  # fmt: skip


def _spent_by_children() -> float:
    """Return the CPU seconds of all processes that this one, or one of those, has started and waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _stored(file: Path) -> dict[str, Entry]:
    """Return what the record of a run holds, by stage; nothing if there is no record yet."""
    if not file.exists():
        return {}
    try:
        return {name: Entry(**entry) for name, entry in json.loads(file.read_text()).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise PipelineError(f"{file}: {error}; expected the record of a run as it was written") from error


def _remove(paths: Sequence[Path]) -> None:
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _name(path: Path, directory: Path) -> str:
    return path.relative_to(directory).as_posix() if path.is_relative_to(directory) else str(path)
