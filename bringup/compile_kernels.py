"""Compile what numba compiles, so that neither the first run nor the first training waits: `make setup` does it.

What has been compiled stays in the cache until its file changes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bringup.command import Stack, oracle
from bringup.evaluate import evaluate
from bringup.exploration import Disturbance
from bringup.record import Job, MixedEpisodes, record
from mujoban_core.bodies import BALL
from mujoban_core.program import read_options, run_command
from mujoban_planner.lesson_source import LessonActor, LessonConfig
from mujoban_planner.push_env import PushEnvironment
from mujoban_planner.samples import Samples, make_batch
from mujoban_planner.search_lessons import SearchActor, SearchConfig
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Experience
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import TRAIN_SEEDS, VALIDATION_SEEDS

PROG: Final = "bringup.compile_kernels"
_NETWORK = NetworkConfig(channels=4, blocks=1)


@dataclass(frozen=True)
class Options:
    """Compile what numba compiles."""


def _learn_from(experience: Experience, kind: str) -> None:
    samples = Samples(*(experience.arrays[f"{kind}.{name}"] for name in Samples._fields))
    make_batch(samples, np.zeros(len(samples.agent), np.int64))
    environment = PushEnvironment(1)
    rows = np.arange(1)
    environment.reset_to(rows, samples.take(rows).boards)
    environment.step(environment.possible().argmax(1))


def _record(folder: Path) -> None:
    """Record episodes that begin in the middle, one at a time: arrays of one row are of another type than of many."""
    episodes = MixedEpisodes(4, TRAIN_SEEDS.start, (3,), advanced=1.0)
    record(Job(folder, "", episodes, Stack(), Disturbance(wander=1.0), batch=1, time_limit=40, run_seed=0))


def main(command_line: Sequence[str] | None = None) -> int:
    """Play and record a little, and make and read the planner's lessons and search for some."""
    read_options(Options, command_line, PROG, __doc__)
    _learn_from(LessonActor(LessonConfig(levels=4), _NETWORK, 0).act(), "demonstrations")
    SearchActor(_NETWORK, SearchConfig(trees=8, expansions=8, steps=40), 0, 0).act()
    evaluate(Stack().policy(), Episodes(2, VALIDATION_SEEDS.start), time_limit=80)
    # Who sees all searches ahead at once, and finds ways to the end of easy levels; whether learned senses do within a
    # few ticks is up to them.
    told = {role: oracle(role, BALL.name) for role in ("estimator", "termination")}
    seeing = Stack(Stack().choices | told).policy()
    for count, difficulty in ((8, 1), (1, 5)):
        evaluate(seeing, Episodes(count, VALIDATION_SEEDS.start, difficulty=difficulty), time_limit=80)
    with tempfile.TemporaryDirectory() as folder:
        _record(Path(folder))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
