"""Whether a run keeps what it has: memory, file descriptors, threads, shared memory and speed over hours.

    python -m benchmarks.soak                     # two hours of the default run: JSON
    python -m benchmarks.soak --hours 0.1 --mode "real time"

The run is `bringup/run_stack.py` in a process of its own, with its children. Slopes are those of a straight line
through the means of blocks, after a start that is left out, with an interval of 95 %. Ctrl-C ends it with what was
measured.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from benchmarks.command import run_benchmark
from benchmarks.running import ROOT, end, family, take_domain
from mujoban_core.signals import StopSignal
from mujoban_msgs_py import topics
from mujoban_msgs_py.runtime.shared_memory import FOLDER
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_sokoban.generator import VALIDATION_SEEDS

MODES: Final[dict[str, list[str]]] = {"lockstep": [], "real time": ["--realtime", "1"]}
COLUMNS: Final = ("megabytes", "file_descriptors", "threads", "shared_megabytes", "ticks_per_second")
_START: Final = 600.0
"""Seconds until the first tick at most; on a busy machine a graph takes long to come up."""


@dataclass(frozen=True)
class Options:
    """How long is watched."""

    hours: float = 2.0
    period: float = 5.0
    """Seconds between two looks."""
    mode: Literal["lockstep", "real time"] = "lockstep"
    settled: float = 0.05
    """Share of the time, from the start on, that counts for nothing."""
    blocks: int = 24
    """Means that a line is drawn through."""


def slope(hours: NDArray[np.float64], values: NDArray[np.float64], blocks: int) -> dict[str, Any]:
    """Return the slope per hour of a line through the means of blocks, its interval of 95 %, and those means.

    Raises:
        ValueError: If there are fewer than 3 values.
    """
    count = min(blocks, len(values))
    if count < 3:
        raise ValueError(f"{len(values)} looks: expected at least 3, so run for longer")
    x, y = (np.array([part.mean() for part in np.array_split(column, count)]) for column in (hours, values))
    line, intercept = np.polyfit(x, y, 1)
    spread = np.sqrt(np.square(y - line * x - intercept).sum() / (count - 2) / np.square(x - x.mean()).sum())
    # Of Student's distribution, within 2 % from 20 blocks on.
    margin = (1.96 + 2.4 / (count - 2)) * spread
    return {
        "per_hour": round(float(line), 4),
        "interval": [round(float(line - margin), 4), round(float(line + margin), 4)],
        "blocks": [round(float(mean), 3) for mean in y],
    }


def _look(pid: int) -> tuple[float, ...]:
    """Return memory in megabytes, descriptors and threads of a process and its children, and shared memory in use."""
    members = family(pid)
    own = [file for file in FOLDER.iterdir() if file.is_file() and file.stat().st_uid == os.getuid()]
    return (
        sum(p.memory_info().rss for p in members) / 1e6,
        sum(p.num_fds() for p in members),
        sum(p.num_threads() for p in members),
        sum(file.stat().st_size for file in own) / 1e6,
    )


class _Ticks(Node):
    """Counts the simulator's ticks."""

    def __init__(self) -> None:
        super().__init__("soak")
        self.count = 0
        self.create_subscription(topics.CLOCK.type, topics.CLOCK.name, self._on_clock, live_qos(1000), raw=True)

    def _on_clock(self, message: bytes) -> None:
        self.count += 1


def watch(options: Options, child: subprocess.Popen[bytes]) -> list[tuple[float, ...]]:
    """Return, every period until the time is over or a signal comes, the hours that have passed and all `COLUMNS`."""
    node, executor, rows = _Ticks(), SingleThreadedExecutor(), list[tuple[float, ...]]()
    executor.add_node(node)
    start = before = began = time.monotonic()
    ticks = 0
    with StopSignal() as stop:
        while not stop.requested and child.poll() is None:
            executor.spin_once(timeout_sec=0.1)
            now = time.monotonic()
            if not node.count:
                if now - began > _START:
                    raise TimeoutError(f"no tick within {_START:.0f} s of the start")
                start = before = now
            elif now - before >= options.period:
                rows.append(((now - start) / 3600, *_look(child.pid), (node.count - ticks) / (now - before)))
                before, ticks = now, node.count
            if now - start >= 3600 * options.hours:
                break
    return rows


def measure(options: Options) -> dict[str, Any]:
    """Return the slopes."""
    take_domain()
    # More episodes than any number of hours holds.
    levels = ["--seed", str(VALIDATION_SEEDS.start), "--episodes", "1000000"]
    command = [sys.executable, "bringup/run_stack.py", "--headless", *levels, *MODES[options.mode]]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rclpy.init()
    try:
        rows = watch(options, child)
    finally:
        survived = child.poll() is None
        end(child)
        rclpy.try_shutdown()
    return {"options": asdict(options), "survived": survived, "status": child.returncode, **summary(rows, options)}


def summary(rows: Sequence[tuple[float, ...]], options: Options) -> dict[str, Any]:
    """Return the slope of each of `COLUMNS` over rows of hours and these, without the start."""
    table = np.array(rows, np.float64).reshape(-1, 1 + len(COLUMNS))
    hours = table[:, 0]
    kept = table[hours >= options.settled * hours.max(initial=0.0)]
    found = {name: slope(kept[:, 0], kept[:, 1 + i], options.blocks) for i, name in enumerate(COLUMNS)}
    return {"hours": round(float(hours.max(initial=0.0)), 3), "looks": len(kept), **found}


if __name__ == "__main__":
    run_benchmark("benchmarks.soak", Options, measure, __doc__)
