"""What bad input does to a run and to readers: `python -m benchmarks.fuzz [--messages N]` prints JSON.

A run of the graph in a process of its own, in lockstep and in real time, is heard and answered by a node that says
again, spoiled, whatever is said on every topic (`benchmarks.malformed`), and calls every service. Before, copies of a
bag, of weights and of levels are damaged, one bit or one cut each, and read: each must be refused by name, or hold what
it held before.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool, Trigger

import mujoban_planner
from benchmarks.command import run_benchmark
from benchmarks.malformed import DEPTH, Vandal
from benchmarks.running import ROOT, megabytes
from bringup.run_stack import main as play
from mujoban_msgs_py.bags import open_bag
from mujoban_rl.weights import record_path
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.levels import read_levels, write_levels

MODES: dict[str, list[str]] = {"lockstep": [], "real time": ["--realtime", "4"]}
_CALLS = (
    ("/pause", SetBool, SetBool.Request(data=True)),
    ("/step", Trigger, Trigger.Request()),
    ("/reset", Trigger, Trigger.Request()),
    ("/pause", SetBool, SetBool.Request(data=False)),
)
"""Services that are called every thousand messages; `megabytes` of the report are measured then, and before all."""
START = 300.0
"""Seconds until the first tick at most; on a busy machine a graph takes long to come up."""
HANG = 30.0
"""Seconds without a tick after which the flood pauses."""
RECOVERY = 120.0
"""Seconds within which the next tick must come while nobody attacks: else it is a hang, not a machine that is busy with
what it is told."""


@dataclass(frozen=True)
class Options:
    """How much is tried."""

    messages: int = 10_000
    """On each topic, in each mode."""
    rate: float = 500.0
    """Of them a second and topic."""
    bags: int = 200
    weights: int = 100
    levels: int = 100
    seed: int = 0
    modes: tuple[Literal["lockstep", "real time"], ...] = ("lockstep", "real time")


def attack(mode: str, options: Options) -> dict[str, Any]:
    """Return what became of a run that was attacked."""
    os.environ["ROS_DOMAIN_ID"] = str(60 + os.getpid() % 40)
    oracles = ["--oracle", "estimator,termination,planner,controller"]
    command = [sys.executable, "bringup/run_stack.py", "--headless", "--episodes", "100000", *oracles, *MODES[mode]]
    with tempfile.TemporaryFile("w+") as said:
        child = subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=said)
        report = {"mode": mode, **_attack(child, options)}
        said.seek(0)
        text = said.read()
    report["last_line"] = next(reversed(text.split("\n")[:-1]), "")
    report["tracebacks"] = text.count("Traceback")
    report["named"] = sorted(set(re.findall(r"rejected a message on (\S+):", text)))
    return report


def _attack(child: subprocess.Popen[bytes], options: Options) -> dict[str, Any]:
    rclpy.init()
    vandal = Vandal(np.random.default_rng(options.seed))
    executor = SingleThreadedExecutor()
    executor.add_node(vandal)

    def spin(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.01)

    def goes_on(seconds: float) -> bool:
        """Wait for more ticks than the vandal may still have to hear of itself."""
        enough, end = vandal.heard + DEPTH, time.monotonic() + seconds
        while vandal.heard <= enough and time.monotonic() < end and child.poll() is None:
            executor.spin_once(timeout_sec=0.01)
        return vandal.heard > enough

    started = goes_on(START)
    clients = {name: vandal.create_client(kind, name) for name, kind, _ in _CALLS}
    memory, stalls, hangs, heard, since = [megabytes(child.pid)], 0, 0, vandal.heard, time.monotonic()
    while started and child.poll() is None and vandal.sent["/clock"] < options.messages:
        burst = 10
        vandal.act(burst)
        spin(burst / options.rate)
        if vandal.heard == heard and time.monotonic() - since > HANG:
            stalls += 1
            hangs += not goes_on(RECOVERY)
            since = time.monotonic()
        if vandal.heard != heard:
            heard, since = vandal.heard, time.monotonic()
        if vandal.sent["/clock"] % 1000 == 0:
            memory.append(megabytes(child.pid))
            for name, _, request in _CALLS:
                clients[name].call_async(request)
                spin(0.2)  # services are heard in any order
    survived = started and goes_on(RECOVERY)
    status = child.poll()
    if status is None:
        child.send_signal(signal.SIGINT)
    child.wait(60)
    rclpy.shutdown()
    return {
        "messages": sum(vandal.sent.values()), "ticks": vandal.heard, "started": started, "crashed": status is not None,
        "stalls": stalls, "hangs": hangs, "goes_on": survived, "status": child.returncode, "megabytes": memory,
    }  # fmt: skip


def damage(paths: list[Path], read: Callable[[], Any], count: int, rng: np.random.Generator) -> Counter[str]:
    """Damage one of some files, read them, and mend it again; return how often what happened."""
    whole, outcomes = {path: path.read_bytes() for path in paths}, Counter[str]()
    expected = read()
    for trial in range(count):
        path = paths[trial % len(paths)]
        data = bytearray(whole[path])
        if trial % 3 == 2:
            del data[int(rng.integers(len(data))) :]
        else:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            outcomes["harmless" if read() == expected else "silently used"] += 1
        except (ValueError, OSError) as error:
            outcomes["named" if str(path.parent) in str(error) else "refused without a name"] += 1
        except Exception as error:
            outcomes[f"crashed: {type(error).__name__}"] += 1
        path.write_bytes(whole[path])
    return outcomes


def files(options: Options) -> dict[str, dict[str, int]]:
    """Return what became of damaged bags, weights and levels."""
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        oracles = ["--oracle", "estimator,termination,planner,controller"]
        play(["--headless", "--difficulty", "1", "--record", str(folder / "bag"), *oracles])
        for path in (mujoban_planner.SHIPPED, record_path(mujoban_planner.SHIPPED)):
            shutil.copy(path, folder)
        weights, levels = folder / mujoban_planner.SHIPPED.name, folder / "levels.txt"
        write_levels(levels, [generate_level(5, seed) for seed in range(8)])
        bag = [folder / "bag" / "metadata.yaml", folder / "bag" / "bag_0.mcap"]
        return {
            "bags": damage(bag, lambda: [(m.topic, m.stamp, m.data) for m in open_bag(bag[0].parent).messages()],
                           options.bags, rng),
            "weights": damage([weights, record_path(weights)],
                              lambda: [float(p.sum()) for p in mujoban_planner.load(weights).parameters()],
                              options.weights, rng),
            "levels": damage([levels], lambda: [level.to_text() for level in read_levels(levels)], options.levels, rng),
        }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Return what became of damaged files and of a graph under attack."""
    damaged = options.bags or options.weights or options.levels
    return {
        "options": asdict(options), "files": files(options) if damaged else {},
        "runs": [attack(mode, options) for mode in options.modes],
    }  # fmt: skip


if __name__ == "__main__":
    run_benchmark("benchmarks.fuzz", Options, measure)
