"""What the record of a finished run of `make weights` says: its seed, whose levels others leave alone, and its body."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from bringup.pipeline import Pipeline

_TRAINERS: Final = ("mujoban_controller.train", "mujoban_planner.train", "mujoban_estimator.train")
"""Programs of which each is told the run's seed."""
_BODY: Final = ("--body", "--task.body")
"""Options by which programs are told the run's body."""


def seed_of(run: Path) -> int:
    """Return the seed of a run: the largest, where some modules are another run's; 0 where none is noted.

    Raises:
        PipelineError: If the record is damaged.
    """
    trained = [command for command in _commands(run) if set(_TRAINERS) & set(command[:2])]
    return max((int(command[command.index("--seed") + 1]) for command in trained), default=0)


def body_of(run: Path) -> str | None:
    """Return the body of a run; None where none is noted.

    Raises:
        PipelineError: If the record is damaged.
    """
    told = (command[command.index(option) + 1] for command in _commands(run) for option in _BODY if option in command)
    return next(told, None)


def _commands(run: Path) -> list[list[str]]:
    return [entry.command for entry in Pipeline.read(run).entries.values()]
