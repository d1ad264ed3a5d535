"""What the live view costs: ticks per second of the graph in lockstep with `--view` and without.

``run`` measures both in turns, several times, so that what else the machine does hits them alike; ratios are medians
over the rounds. The viewer has started before the clock does, and no browser is open, which costs what drawing costs
on its machine. The processor time of the graph's process says the same on a machine that is busy otherwise: where a
core is free for the viewer, the rate falls as much as this time grows. ``python -m benchmarks.view`` prints it as JSON.
"""

from __future__ import annotations

import os
import statistics
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from urllib.error import URLError

import torch

from benchmarks.command import run_benchmark
from benchmarks.graph import Options
from bringup.command import Stack
from bringup.domain import claim_domain
from bringup.live_server import free_port
from bringup.monitor import MonitorNode
from bringup.options import LOOPBACK
from bringup.results import EpisodeResult
from bringup.stack import PlayOptions, play, viewer
from mujoban_msgs_py.runtime.discovery import DOMAIN
from mujoban_sokoban.episodes import Episodes

WEB_PORT = 9090
"""Where the viewer looks for a free port."""
START_LIMIT = 60.0
"""Seconds that the viewer has to start."""


@contextmanager
def _one_domain() -> Iterator[None]:
    """Name one free ROS domain to all that starts meanwhile; a graph that is played claims it itself."""
    with claim_domain() as domain:
        pass
    before = os.environ.get(DOMAIN)
    os.environ[DOMAIN] = str(domain)
    try:
        yield
    finally:
        if before is None:
            del os.environ[DOMAIN]


def _await_page(port: int) -> None:
    deadline = time.monotonic() + START_LIMIT
    while True:
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5).close()
            return
        except URLError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _measure(stack: Stack, episodes: Episodes, options: PlayOptions) -> tuple[float, float]:
    """Return ticks per second, and milliseconds of processor time that this process spends on a tick."""
    seen: list[tuple[int, float]] = []

    def note(monitor: MonitorNode, _: Sequence[EpisodeResult]) -> None:
        seen.append((monitor.ticks, time.process_time()))

    rate = play(stack, episodes, options, on_refresh=note).ticks_per_second
    # From the first tick on: making the nodes does not count.
    running = [(tick, seconds) for tick, seconds in seen if tick > 0]
    (first, start), (last, end) = running[0], running[-1]
    return rate, 1000 * (end - start) / (last - first)


def run(options: Options | None = None) -> dict[str, float]:
    """Return ticks per second and processor time of the graph without and with the live view, and their ratios."""
    chosen = options or Options()
    torch.set_num_threads(1)
    stack = chosen.stack()
    episodes = Episodes(1, chosen.seed, difficulty=chosen.difficulty)
    plain: list[tuple[float, float]] = []
    viewed: list[tuple[float, float]] = []
    with _one_domain():
        play(stack, episodes, replace(chosen, ticks=20).play_options())
        for _ in range(chosen.rounds):
            plain.append(_measure(stack, episodes, chosen.play_options()))
            port = free_port(WEB_PORT)
            with viewer(LOOPBACK):
                _await_page(port)
                viewed.append(_measure(stack, episodes, chosen.play_options()))
    pairs = list(zip(plain, viewed, strict=True))
    return {
        "ticks_per_second": statistics.median(rate for rate, _ in plain),
        "ticks_per_second_with_view": statistics.median(rate for rate, _ in viewed),
        "rate_with_view_of_without": statistics.median(b / a for (a, _), (b, _) in pairs),
        "milliseconds_of_processor": statistics.median(cost for _, cost in plain),
        "milliseconds_of_processor_with_view": statistics.median(cost for _, cost in viewed),
        "processor_without_view_of_with": statistics.median(a / b for (_, a), (_, b) in pairs),
    }


if __name__ == "__main__":
    run_benchmark("benchmarks.view", Options, lambda chosen: {"options": asdict(chosen), **run(chosen)})
