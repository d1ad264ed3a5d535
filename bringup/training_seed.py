"""The seed of a finished run of `make weights`, by its record: one that goes on from it draws other levels."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from bringup.pipeline import Pipeline

_TRAINERS: Final = ("mujoban_controller.train", "mujoban_planner.train", "mujoban_estimator.train")
"""Programs of which each is told the run's seed."""


def seed_of(run: Path) -> int:
    """Return the seed of a run: the largest, where some modules are another run's; 0 where none is noted.

    Raises:
        PipelineError: If the record is damaged.
    """
    commands = [entry.command for entry in Pipeline.read(run).entries.values()]
    trained = [command for command in commands if set(_TRAINERS) & set(command[:2])]
    return max((int(command[command.index("--seed") + 1]) for command in trained), default=0)
