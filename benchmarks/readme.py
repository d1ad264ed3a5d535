"""Run every command block of the README as it is written, in a copy of the repository: `python -m benchmarks.readme`.

Each command has a terminal of its own. One that has not ended after `--limit` seconds of CPU time gets Ctrl-C, and has
to end as interrupted; what is to be typed in a second terminal runs while the command before it does. In order is what
ends with status 0, or 130 after Ctrl-C, without a traceback, and leaves the files that it was given to write.
"""

from __future__ import annotations

import itertools
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.command import run_benchmark
from benchmarks.running import GIVE_UP, ROOT, Run, cpu_seconds
from mujoban_core.signals import interruptible

_SECOND: Final = "in a second terminal:"
_WRITTEN: Final = ("--video", "--json", "--record", "--out")
"""Options that name what a command writes."""
_PATIENCE: Final = 20.0
"""Times the limit that a command may take by the clock, on a busy machine or where it waits."""
_SECOND_SECONDS: Final = 5.0
"""For which a command of the second terminal goes on after its first words."""


@dataclass(frozen=True)
class Options:
    """What is run, and for how long."""

    only: tuple[str, ...] = ()
    """Parts of commands; those that have one of them are run, all without this option."""
    skip: tuple[str, ...] = ()
    """Parts of commands; those that have one of them are not run."""
    limit: float = 600.0
    """CPU seconds after which a command gets Ctrl-C."""
    fresh: bool = False
    """Let `make` set up .venv anew, over the network, in place of the environment that runs this."""


@dataclass(frozen=True)
class Source:
    """A file of the README, named in the comment of its first line."""

    name: str
    text: str


@dataclass(frozen=True)
class Command:
    """A command of the README, and what is typed in a second terminal meanwhile."""

    line: str
    beside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What came of a command."""

    command: str
    seconds: float
    stopped: bool
    """Whether it got Ctrl-C."""
    status: int
    last_words: str
    faults: tuple[str, ...]


def read_page(text: str) -> list[Source | Command]:
    """Return the files and commands of a page, in its order.

    Raises:
        ValueError: If a fenced block is neither a file whose first line names it, nor a diagram.
    """
    found: list[Source | Command] = []
    fenced = r"^```(?P<kind>\w*)\n(?P<body>.*?)^```$"
    for match in re.finditer(rf"{fenced}|(?P<lines>(?:^ {{4}}[^\n]*\S\n?)+)", text, re.MULTILINE | re.DOTALL):
        if match["lines"]:
            found += _commands([line.strip() for line in match["lines"].replace("\\\n", " ").splitlines()])
        elif match["kind"] != "mermaid":
            named = re.match(r"# (\S+)\n", match["body"])
            if named is None:
                raise ValueError(f"{match['body'][:60]!r}: expected a first line that names the file")
            found.append(Source(named[1], match["body"]))
    return found


def _commands(lines: Sequence[str]) -> Iterator[Command]:
    """Yield commands; those after one that calls for a second terminal go with it as long as they are of `ros2`."""
    rest = list(lines)
    while rest:
        line, beside = rest.pop(0), []
        while line.endswith(_SECOND) and rest and rest[0].startswith("ros2 "):
            beside.append(rest.pop(0))
        yield Command(line, tuple(beside))


def copy_repository(folder: Path, fresh: bool) -> None:
    """Copy what the repository holds, with changes, into a folder; unless `fresh`, lend it this environment."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    if fresh:
        return
    shutil.copytree(ROOT / "mujoban_msgs", folder / "mujoban_msgs", dirs_exist_ok=True)
    for compiled in (p for package in ROOT.glob("*/__init__.py") for p in package.parent.rglob("__pycache__")):
        # What another process is just writing is gone a moment later.
        unfinished = shutil.ignore_patterns("*.tmp.*", "*.pyc.*")
        shutil.copytree(compiled, folder / compiled.relative_to(ROOT), ignore=unfinished, dirs_exist_ok=True)
    (folder / ".venv").mkdir()
    for part in Path(sys.prefix).iterdir():
        (folder / ".venv" / part.name).symlink_to(part)
    # Newer than what `make` compares it with, so that nothing is installed into the environment that is lent.
    for stamp in (".packages", ".installed"):  # in the order in which `make` has them
        (folder / ".venv" / stamp).unlink(missing_ok=True)
        (folder / ".venv" / stamp).touch()


class Terminal(Run):
    """A command of the README in a terminal of its own."""

    def __init__(self, line: str, folder: Path, fresh: bool) -> None:
        """Start the command as somebody in the repository's folder would."""
        script = ["unset VIRTUAL_ENV PYTHONPATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE"]
        if not fresh:
            script.append(f"export PYTHONPATH={shlex.quote(str(folder))}")
        if not line.startswith("make"):
            script.append(". .venv/bin/activate")
        environment = {"PYTHON": getattr(sys, "_base_executable", sys.executable), "TERM": "xterm"}
        super().__init__(["bash", "-c", "\n".join([*script, line])], True, folder, environment)
        self.line, self.folder = line, folder
        self._start = time.monotonic()
        self._stopped = False

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.process.poll() is not None

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._start

    def follow(self, limit: float) -> None:
        """Wait until it has ended, or has taken `limit` seconds of CPU time or many times that by the clock."""
        while not self.is_over and cpu_seconds(self.process.pid) < limit and self.seconds < _PATIENCE * limit:
            time.sleep(0.1)

    def listen(self, limit: float) -> None:
        """Wait until it has said something and a little more, or has ended, for `follow`'s time at most."""
        while not self.is_over and not self.said and self.seconds < _PATIENCE * limit:
            time.sleep(0.1)
        deadline = time.monotonic() + _SECOND_SECONDS
        while not self.is_over and time.monotonic() < deadline:
            time.sleep(0.1)

    def finish(self) -> Outcome:
        """Press Ctrl-C if it has not ended, and return what came of it."""
        faults = []
        if not self.is_over:
            self._stopped = True
            self.interrupt(signal.SIGINT)
            try:
                self.process.wait(GIVE_UP)
            except subprocess.TimeoutExpired:
                faults.append(f"did not end within {GIVE_UP:.0f} s of Ctrl-C")
                self.process.kill()
        seconds, status = self.seconds, self.process.wait()
        self.close()
        expected = (0, 128 + signal.SIGINT, -signal.SIGINT) if self._stopped else (0,)
        if status not in expected:
            faults.append(f"status {status}")
        if "Traceback" in self.said:
            faults.append("a traceback")
        if not self.said:
            faults.append("says nothing")
        faults += [f"{name} is missing" for name in self._files() if not self._stopped]
        return Outcome(self.line, round(seconds, 1), self._stopped, status, self.last_words[-200:], tuple(faults))

    def _files(self) -> list[str]:
        """Return what it was to write and has not."""
        words = shlex.split(self.line, comments=True)
        named = [value for option, value in itertools.pairwise(words) if option in _WRITTEN]
        return [name for name in named if not (self.folder / name).exists()]


def play(command: Command, folder: Path, options: Options) -> Iterator[Outcome]:
    """Run a command, and what belongs into a second terminal beside it, and yield what came of each."""
    with Terminal(command.line, folder, options.fresh) as first:
        if command.beside:
            first.listen(options.limit)
        for line in command.beside:
            with Terminal(line, folder, options.fresh) as second:
                second.listen(options.limit)
                yield second.finish()
        if not command.beside:
            first.follow(options.limit)
        yield first.finish()


def run(options: Options) -> dict[str, Any]:
    """Run the commands of the README that are asked for; return how many were in order, and what came of each."""
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="mujoban-readme-") as name, interruptible():
        folder = Path(name)
        copy_repository(folder, options.fresh)
        for part in read_page((folder / "README.md").read_text()):
            if isinstance(part, Source):
                (folder / part.name).write_text(part.text)
            elif _is_chosen(part, options):
                for outcome in play(part, folder, options):
                    outcomes.append(outcome)
                    how = ", ".join(outcome.faults) or ("in order until Ctrl-C" if outcome.stopped else "in order")
                    print(f"{outcome.command}: {how}, {outcome.seconds} s", file=sys.stderr)
    return {"in_order": sum(not o.faults for o in outcomes), "commands": [asdict(o) for o in outcomes]}


def _is_chosen(command: Command, options: Options) -> bool:
    wanted = not options.only or any(part in command.line for part in options.only)
    return wanted and not any(part in command.line for part in options.skip)


if __name__ == "__main__":
    run_benchmark("benchmarks.readme", Options, run, __doc__)
