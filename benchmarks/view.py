"""What the live view costs: ticks per second of the graph in lockstep with `--view` and without.

``run`` measures both in turns, several times, so that what else the machine does hits them alike; the ratio is the
median over the rounds. The viewer has started before the clock does, and no browser is open, which costs what drawing
costs on its machine. ``python -m benchmarks.view`` prints it as JSON.
"""

from __future__ import annotations

import json
import statistics
import time
import urllib.request
from dataclasses import asdict, dataclass
from urllib.error import URLError

import torch
import tyro

from bringup.command import Choice, Stack
from bringup.domain import claim_domain
from bringup.live import free_port
from bringup.stack import PlayOptions, play, viewer
from mujoban_sim.episodes import Episodes
from mujoban_sim.plugins import ROLES

WEB_PORT = 9090
"""Where the viewer looks for a free port."""
START_LIMIT = 60.0
"""Seconds that the viewer has to start."""


@dataclass
class Options:
    """What is measured."""

    ticks: int = 300
    """Of each contestant in a round."""
    rounds: int = 5
    difficulty: int = 5
    seed: int = 0
    oracle: tuple[str, ...] = ()
    """Roles that oracles play; none by default."""


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


def run(options: Options | None = None) -> dict[str, float]:
    """Return ticks per second of the graph without and with the live view, and their ratio."""
    chosen = options or Options()
    torch.set_num_threads(1)
    stack = Stack({role: Choice(role, "oracle" if role in chosen.oracle else "learned") for role in ROLES})
    episodes = Episodes(1, chosen.seed, difficulty=chosen.difficulty)
    length = PlayOptions(time_limit=chosen.ticks)
    rates: list[tuple[float, float]] = []
    with claim_domain():
        play(stack, episodes, PlayOptions(time_limit=20))
        for _ in range(chosen.rounds):
            plain = play(stack, episodes, length).ticks_per_second
            port = free_port(WEB_PORT)
            with viewer():
                _await_page(port)
                rates.append((plain, play(stack, episodes, length).ticks_per_second))
    return {

        "ticks_per_second": statistics.median(plain for plain, _ in rates),
        "ticks_per_second_with_view": statistics.median(viewed for _, viewed in rates),
        "with_view_of_without": statistics.median(viewed / plain for plain, viewed in rates),
    }


if __name__ == "__main__":
    chosen_options = tyro.cli(Options)
    print(json.dumps({"options": asdict(chosen_options), **run(chosen_options)}, indent=2))
