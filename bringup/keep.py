"""Take over what a stage of a former run made: `python -m bringup.keep --made runs/all/planner --out runs/b/planner`.

A stage of `make weights --continue RUN --keep MODULE`. Weights, records and curves are copied; checkpoints are not.
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

from mujoban_core.program import read_options, run_command

PROG: Final = "bringup.keep"
_LEFT: Final = ("checkpoint-*", "tensorboard")


@dataclass(frozen=True)
class Options:
    """Copy what a stage made."""

    made: Path
    """Directory of the stage in the former run."""
    out: Path
    """Directory of the stage in the new one."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    if not options.made.is_dir():
        raise ValueError(f"--made {options.made}: expected the directory of a stage that is done")
    shutil.copytree(options.made, options.out, ignore=shutil.ignore_patterns(*_LEFT), dirs_exist_ok=True)
    print(options.out)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
