"""The rows of Table 1 from nothing, one after the other: `python -m benchmarks.paper.table1`, in the repository's root.

Each agent is trained by the commands that stand below the table, what that cost and its curve are noted, and its
weights play the test levels of every difficulty. Stop it at any time: the same command goes on where it was. What is
done stands in `runs/table1/NAME/pipeline.json`, with logs beside; `make results` then shows it.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.paper import runs as evaluations
from benchmarks.paper.baselines import AGAIN, BASELINES, HOURS, RECORDING, Baseline
from benchmarks.paper.baselines import PROG as NOTING
from bringup.pipeline import Pipeline, Stage
from bringup.training_display import run_shown
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.program import read_options, run_command

PROG: Final = "benchmarks.paper.table1"
KNOWN: Final = {baseline.name: baseline for baseline in (*BASELINES, *AGAIN)}
"""All rows that there can be, those with another seed last."""
_BAGS: Final = "stack"
_BOTH: Final = 2
"""Cores that a training has, and an evaluation."""
_RECORDED: Final = 1200.0
"""Seconds that the recording of what is cloned takes, more or less."""
_LEVELS: Final = 1500.0
"""And the test levels of one difficulty."""


@dataclass(frozen=True)
class Options:
    """Train and evaluate what Table 1 compares."""

    only: tuple[str, ...] = ()
    """Names of rows; by default all but those with another seed, the modular one first, as its steps are the others'
    budget."""
    run: Path = Path("runs/table1")
    """Where what is done is noted; the trainings have folders of their own, `runs/baselines/NAME`."""

    def __post_init__(self) -> None:
        """Reject unknown rows, and a folder in which the commands would not find what they name."""
        if unknown := [name for name in self.only if name not in KNOWN]:
            raise ValueError(f"--only {' '.join(unknown)}: expected some of {', '.join(KNOWN)}")
        if Path.cwd() != evaluations.ROOT:
            raise ValueError(f"{Path.cwd()}: expected to run in the repository's root, {evaluations.ROOT}")


def recording() -> Stage:
    """Return the stage that records what is cloned."""
    _, *command = shlex.split(RECORDING)
    folder = Path(command[command.index("--out") + 1])
    return Stage(_BAGS, tuple(command), (folder,), seconds=_RECORDED, cores=_BOTH, resumes=False)


def stages(baseline: Baseline) -> list[Stage]:
    """Return how a row comes about: its trainings, the note of what they cost, its evaluations."""
    found = list(_trainings(baseline))
    if found:
        note = ("-m", NOTING, f"{baseline.name}={baseline.folder.relative_to(evaluations.ROOT)}")
        found.append(Stage(f"{baseline.name}_curve", note, (baseline.curve,), (found[-1].name,), seconds=5.0))
    played = [baseline.run(difficulty) for difficulty in DIFFICULTIES]
    command = ("-m", evaluations.PROG, "--only", *(run.name for run in played))
    needs = tuple(stage.name for stage in found)
    seconds = _LEVELS * len(played)
    files = tuple(run.file for run in played)
    return [*found, Stage(f"{baseline.name}_levels", command, files, needs, seconds, _BOTH)]


def _trainings(baseline: Baseline) -> Iterator[Stage]:
    """Yield the trainings of a row, each of which begins with what the one before has made."""
    needs: tuple[str, ...] = ()
    commands = [shlex.split(text)[1:] for text in baseline.commands]
    for command in commands:
        folder = Path(command[command.index("--run") + 1])
        # What the last one makes is what plays; one before it makes an agent to start from.
        played = tuple(baseline.run(1).own.values()) if command is commands[-1] else ()
        products = played or (folder / "agent.safetensors",)
        yield Stage(folder.name, tuple(command), products, needs, HOURS * 3600.0, _BOTH)
        needs = (folder.name,)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    chosen = [KNOWN[name] for name in options.only] or BASELINES
    if any("--bags" in command for baseline in chosen for command in baseline.commands):
        run_shown(Pipeline(options.run / _BAGS, [recording()]))
    for baseline in chosen:
        # Not before those ahead of it are done: the modular row's steps are the budget of all others.
        run_shown(Pipeline(options.run / baseline.name, stages(baseline)))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
