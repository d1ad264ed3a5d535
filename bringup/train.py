"""Train a module: `mujoban-train controller|planner|estimator|baselines OPTIONS`, or `python -m bringup.train ...`."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Final, NoReturn

from mujoban_core.program import called, run_command

PROG = "train.py"
TRAINERS: Final = {
    "controller": "mujoban_controller.train",
    "planner": "mujoban_planner.train",
    "estimator": "mujoban_estimator.train",
    "baselines": "mujoban_baselines.train",
}
"""What can be trained; estimator and termination learn together."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the trainer that the first argument names, with the arguments that follow."""
    name, *rest = [*(sys.argv[1:] if command_line is None else command_line), ""]
    prog, names = called(PROG), "|".join(TRAINERS)
    if name in ("-h", "--help"):
        print(f"usage: {prog} {names} [OPTIONS]; each tells its options with --help")
        return 0
    if name not in TRAINERS:
        raise ValueError(f"module {name or 'missing'}, expected {names}")
    return import_module(TRAINERS[name]).main(rest[:-1], f"{prog} {name}")


def run() -> NoReturn:
    """Run the command and end the process."""
    run_command(PROG, main)


if __name__ == "__main__":
    run()
