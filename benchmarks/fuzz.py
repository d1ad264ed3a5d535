"""What bad input does to a run and to readers: `python -m benchmarks.fuzz [--messages N]` prints JSON.

A run of the graph, in one process and in one for each node, in lockstep and in real time, is heard and answered by a
node that says again, spoiled, whatever is said on every topic (`benchmarks.malformed`), and then calls every service,
those of parameters among them (`benchmarks.malformed_calls`). Before, copies of a bag, of weights and of levels are
damaged, one bit or one cut each, and read: each must be refused by name, or hold what it held before.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stdout
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
from benchmarks.malformed_calls import Caller
from benchmarks.running import ROOT, end, family, megabytes, take_domain
from bringup.run_stack import main as play
from mujoban_msgs_py.bags import open_bag
from mujoban_rl.weights import record_path
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.levels import read_levels, write_levels

_ORACLES = ["--oracle", "estimator,termination,planner,controller"]
MODES: dict[str, list[str]] = {
    "lockstep": _ORACLES,
    "real time": [*_ORACLES, "--realtime", "4"],
    "processes": ["--processes"],
    "processes, real time": ["--processes", "--realtime", "4"],
}
"""Learned modules, of which parameters change the weights, in processes; oracles, which are faster, in one process."""
_CALLS = (
    ("/pause", SetBool.Request(data=True)),
    ("/step", Trigger.Request()),
    ("/reset", Trigger.Request()),
    ("/pause", SetBool.Request(data=False)),
)
"""Services that are called every thousand messages; `megabytes` of the report are measured then, and before all."""
ANSWERED = 10.0
"""Seconds within which a service must have answered."""
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
    calls: int = 10_000
    """Of each service, in each mode."""
    rate: float = 500.0
    """Of them a second and topic."""
    bags: int = 200
    weights: int = 100
    levels: int = 100
    seed: int = 0
    modes: tuple[Literal["lockstep", "real time", "processes", "processes, real time"], ...] = (
        "lockstep", "real time", "processes", "processes, real time",
    )  # fmt: skip


def attack(mode: str, options: Options) -> dict[str, Any]:
    """Return what became of a run that was attacked."""
    take_domain()
    command = [sys.executable, "bringup/run_stack.py", "--headless", "--episodes", "100000", *MODES[mode]]
    with tempfile.TemporaryFile("w+") as said:
        child = subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=said)
        try:
            report = {"mode": mode, **_Attack(child, options).report()}
        finally:
            status = end(child)
        report["status"] = status
        said.seek(0)
        text = said.read()
    report["last_line"] = next(reversed(text.split("\n")[:-1]), "")
    report["tracebacks"] = text.count("Traceback")
    report["named"] = sorted(set(re.findall(r"rejected a message on (\S+):", text)))
    return report


class _Attack:
    """A run, and a node that attacks it."""

    def __init__(self, child: subprocess.Popen[bytes], options: Options) -> None:
        rclpy.init()
        rng = np.random.default_rng(options.seed)
        self._child, self._options = child, options
        self._vandal = Vandal(rng)
        self._caller = Caller(self._vandal, rng)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._vandal)
        self._stalls = self._hangs = 0
        self._heard, self._since = 0, time.monotonic()
        self._memory = list[int]()

    def report(self) -> dict[str, Any]:
        """Flood topics, then services; return what became of the run."""
        child, vandal, caller = self._child, self._vandal, self._caller
        started = self._goes_on(START)
        processes = {member.pid for member in family(child.pid)}
        self._heard, self._since = vandal.heard, time.monotonic()
        self._measure()
        started = started and self._until(self._met, START)
        if started:
            self._flood_topics()
            self._flood_services()
        survived = started and self._goes_on(RECOVERY)
        silent = [name for name in caller.services if not self._answers(name)]
        lost = len(processes - {member.pid for member in family(child.pid)})
        crashed = child.poll() is not None
        rclpy.shutdown()
        return {
            "messages": sum(vandal.sent.values()), "calls": caller.sent.total(), "answered": caller.answered.total(),
            "services": len(caller.services), "silent_services": silent, "ticks": vandal.heard, "started": started,
            "crashed": crashed, "lost_processes": lost, "stalls": self._stalls, "hangs": self._hangs,
            "goes_on": survived, "megabytes": self._memory,
        }  # fmt: skip

    def _met(self) -> bool:
        self._caller.meet()
        return {name for name, _ in _CALLS} <= set(self._caller.services)

    def _flood_topics(self) -> None:
        burst = 10
        while self._child.poll() is None and self._vandal.sent["/clock"] < self._options.messages:
            self._vandal.act(burst)
            self._spin(burst / self._options.rate)
            self._watch()
            if self._vandal.sent["/clock"] % 1000 == 0:
                self._measure()
                for name, request in _CALLS:
                    self._caller.call(name, request)
                    self._spin(0.2)  # services are heard in any order

    def _flood_services(self) -> None:
        called, burst = 0, 5  # a service keeps 10 calls: of more, some are lost, and waited for in vain
        while self._child.poll() is None and called < self._options.calls:
            if called % 1000 == 0:
                self._caller.meet()
                self._measure()
            calls = self._caller.act(burst)
            called += burst
            self._until(lambda calls=calls: all(call.done() for call in calls), ANSWERED)
            self._caller.call(*_CALLS[-1])
            self._spin(0.05)
            self._watch()
        self._measure()

    def _measure(self) -> None:
        self._memory.append(sum(megabytes(member.pid) for member in family(self._child.pid)))

    def _watch(self) -> None:
        """Count stalls, and wait until they are over."""
        if self._vandal.heard == self._heard and time.monotonic() - self._since > HANG:
            self._stalls += 1
            self._hangs += not self._goes_on(RECOVERY)
            self._since = time.monotonic()
        if self._vandal.heard != self._heard:
            self._heard, self._since = self._vandal.heard, time.monotonic()

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.01)

    def _until(self, done: Callable[[], bool], seconds: float) -> bool:
        """Spin until something is done, the time is over or the run has ended; return whether it was done."""
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end and self._child.poll() is None:
            self._executor.spin_once(timeout_sec=0.01)
        return done()

    def _goes_on(self, seconds: float) -> bool:
        """Wait for more ticks than the vandal may still have to hear of itself."""
        enough = self._vandal.heard + DEPTH
        return self._until(lambda: self._vandal.heard > enough, seconds)

    def _answers(self, service: str) -> bool:
        """Return whether a service answers a sound call."""
        return self._until(self._caller.call(service).done, ANSWERED)


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
        with redirect_stdout(sys.stderr):
            play(["--headless", "--difficulty", "1", "--record", str(folder / "bag"), *_ORACLES])
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
    report = {"options": asdict(options), "files": files(options) if damaged else {}, "runs": list[dict[str, Any]]()}
    for mode in options.modes:
        report["runs"].append(attack(mode, options))
        print(f"{mode}: {report['runs'][-1]}", file=sys.stderr, flush=True)
    return report


if __name__ == "__main__":
    run_benchmark("benchmarks.fuzz", Options, measure)
