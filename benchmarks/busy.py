"""What a busy machine leaves of a run: ticks per second beside other work, and without: `python -m benchmarks.busy`.

The default run, `bringup/run_stack.py --headless`, plays in a process of its own, in turns alone and beside processes
that do nothing but compute; rates are medians over the rounds. On c cores a single thread beside n of them gets
c / (n + 1) of a core.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_benchmark
from benchmarks.interrupts import busy
from benchmarks.running import ROOT
from mujoban_sokoban.generator import VALIDATION_SEEDS


@dataclass(frozen=True)
class Options:
    """Measure."""

    load: int = 5
    """Processes that keep the machine busy."""
    ticks: int = 1200
    """Longest episode."""
    rounds: int = 3


def rate(ticks: int) -> float:
    """Return the ticks per second of an episode of the default run."""
    with tempfile.TemporaryDirectory(prefix="mujoban-busy-") as folder:
        report = Path(folder) / "report.json"
        subprocess.run(
            [sys.executable, "bringup/run_stack.py", "--headless", "--seed", str(VALIDATION_SEEDS.start),
             "--time-limit", str(ticks), "--json", str(report)],
            cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return json.loads(report.read_text())["ticks_per_second"]


def run(options: Options) -> dict[str, Any]:
    """Return the median rates and their ratio."""
    idle, loaded = [], []
    for _ in range(options.rounds):
        idle.append(rate(options.ticks))
        with busy(options.load):
            loaded.append(rate(options.ticks))
    alone, beside = statistics.median(idle), statistics.median(loaded)
    return {
        "options": asdict(options),
        "idle_ticks_per_second": round(alone, 1),
        "busy_ticks_per_second": round(beside, 1),
        "ratio": round(beside / alone, 3),
    }


if __name__ == "__main__":
    run_benchmark("benchmarks.busy", Options, run, __doc__)
