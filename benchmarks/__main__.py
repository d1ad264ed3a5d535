"""All measurements in one run, as JSON: `make bench`, or `python -m benchmarks [NAME ...]`."""

from __future__ import annotations

import importlib
import os
import platform
from dataclasses import dataclass
from typing import Annotated, Any, Final

import tyro

from benchmarks.command import run_benchmark

DEFAULT: Final = ("world", "rendering", "graph", "levels", "actors", "baselines")
"""Benchmarks of speed; each has a `run` that returns a mapping."""


@dataclass(frozen=True)
class Options:
    """Measure."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = DEFAULT
    """What is measured."""

    def __post_init__(self) -> None:
        """Reject benchmarks that there are not."""
        unknown = [name for name in self.names if name not in DEFAULT]
        if unknown:
            raise ValueError(f"{unknown[0]}: expected some of {', '.join(DEFAULT)}")


def measure(options: Options) -> dict[str, Any]:
    """Return the reports of the benchmarks by name."""
    # The comparison with MuJoCo's own renderer needs a backend that works without a display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    return {
        "machine": {"cores": os.cpu_count(), "load": os.getloadavg()[0], "python": platform.python_version()},
        **{name: importlib.import_module(f"benchmarks.{name}").run() for name in options.names},
    }


if __name__ == "__main__":
    run_benchmark("benchmarks", Options, measure, __doc__)
