"""Copy what a run of `make weights` needs to go on elsewhere: `python -m bringup.carry --run runs/all --out DIR`.

Of some 20 MB instead of many GB: the weights that its stages have made, with records and curves, and of trainings under
way a light checkpoint (see `mujoban_rl.run_directory.copy_light`). Recorded bags are left out; they are recorded again
where a stage needs them. Copy it to the run's place on the other machine, and give the run's command again.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bringup.pipeline import Pipeline
from mujoban_core.program import read_options, run_command
from mujoban_rl.engine import CARRIED
from mujoban_rl.run_directory import copy_light

PROG: Final = "bringup.carry"
_KEPT: Final = {".json", ".jsonl", ".md", ".png", ".safetensors", ".txt"}
"""Suffixes of what is copied: weights, records, curves, logs."""
_CHECKPOINT: Final = "checkpoint-"
_RECORDING: Final = "bringup.record"


@dataclass(frozen=True)
class Options:
    """Copy a run without its bags, and without what its trainings have gathered."""

    run: Path
    """Directory of a run that is stopped."""
    out: Path
    """Directory that gets the copy; one that does not exist."""


def carry(run: Path, out: Path) -> None:
    """Copy a run.

    Raises:
        ValueError: If there is no run, or something where the copy is to be.
        PipelineError: If its record is damaged, or its stages run.
        RunError: If a training under way has no intact checkpoint.
    """
    if not (run / "pipeline.json").exists():
        raise ValueError(f"--run {run}: no pipeline.json, expected the directory of a run of make weights")
    if out.exists():
        raise ValueError(f"--out {out}: exists, expected a directory to make")
    pipeline = Pipeline.read(run)
    with pipeline.alone():
        recordings = {name for name, entry in pipeline.entries.items() if _RECORDING in entry.command}
        for file in sorted(path for path in run.rglob("*") if path.suffix in _KEPT):
            place = file.relative_to(run)
            if place.parts[0] not in recordings and not file.name.startswith(_CHECKPOINT):
                target = out / place
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)
        for name, entry in pipeline.entries.items():
            if not entry.done and name not in recordings:
                copy_light(run / name, out / name, CARRIED)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    carry(options.run, options.out)
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    print(f"{options.out}: {size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
