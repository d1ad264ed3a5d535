"""Environment steps per second of monolithic MPO, size S, with camera: collected and learned from together.

Measured from the first update on, from one delivery of the actors to another, without checkpoints: with the settings of
Table 1's rows, which learn from each step four times, and with these but once, as the trainer does by default; and with
all of the trainer's own, these also with the rows' actors, where the learner and the robots each have a process and, on
two cores, a core.

``python -m benchmarks.baselines`` prints JSON.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from benchmarks.command import run_benchmark
from benchmarks.paper.baselines import BASELINES
from mujoban_baselines.train import COMMANDS, MPO_PACE, MonolithicMPO, MPORunConfig, mpo_parts
from mujoban_core.program import read_options
from mujoban_core.ranges import check_positive
from mujoban_core.threads import set_threads
from mujoban_rl.actors import ActorOptions
from mujoban_rl.limits import NaNGuard
from mujoban_rl.precision import bfloat16_pays

_ROW: Final = "mpo_hard"


class Rate(NamedTuple):
    """How fast a training was."""

    steps_per_second: float
    steps_per_cpu_second: float
    """Of all its processes, which other work on the machine hardly changes."""


def settings() -> dict[str, tuple[MPORunConfig, ActorOptions]]:
    """Return what is measured, by name."""
    # Behind `python -m PROGRAM`.
    (words,) = (row.commands[0].split() for row in BASELINES if row.name == _ROW)
    row = read_options(COMMANDS, words[3:], words[2])
    assert isinstance(row, MonolithicMPO)
    own = MPORunConfig()
    once = replace(row.config, mpo=replace(row.config.mpo, reuse=own.mpo.reuse))
    return {
        "table_1": (row.config, row.actors),
        "table_1_but_each_step_once": (once, row.actors),
        "defaults": (own, ActorOptions()),
        "defaults_with_the_actors_of_table_1": (own, row.actors),
    }


def rate(config: MPORunConfig, actors: ActorOptions, seconds: float) -> Rate:
    """Train for at least some seconds, and before that until learning has begun; return how fast it was."""
    (learner, source), guard = mpo_parts(config, actors), NaNGuard()

    def deliveries() -> Iterator[tuple[float, float, int]]:
        """Learn for ever; yield time, CPU time and steps so far whenever actors have delivered some thousand steps."""
        steps = 0
        for update in itertools.count():
            if update % MPO_PACE["publish_updates"] == 0:
                source.publish(learner.weights(), update)
            batch = source.next_batch()
            if update and source.samples > steps:
                steps = source.samples
                yield time.perf_counter(), time.process_time() + source.worker_cpu_seconds(), steps
            learner.update(batch, 0.0, guard)

    try:
        found = deliveries()
        start, cpu, steps = next(found)
        last, last_cpu, last_steps = next(now for now in found if now[0] - start >= seconds)
        return Rate((last_steps - steps) / (last - start), (last_steps - steps) / (last_cpu - cpu))
    finally:
        source.close()


def run(seconds: float = 30.0) -> dict[str, Any]:
    """Measure all settings, each for some seconds of learning.

    Returns:
        Environment steps per second, and per CPU second, by setting; whether this machine computes in bfloat16, and its
        load before (1 minute mean of waiting and running processes).
    """
    load = os.getloadavg()[0]
    set_threads(1)
    rates = {name: rate(*chosen, seconds) for name, chosen in settings().items()}
    by_kind = {kind: {name: getattr(found, kind) for name, found in rates.items()} for kind in Rate._fields}
    return {**by_kind, "bfloat16": bfloat16_pays("cpu"), "load": load}


@dataclass(frozen=True)
class Options:
    """What to measure."""

    seconds: float = 30.0
    """For each setting."""

    def __post_init__(self) -> None:
        """Reject a time that never comes."""
        check_positive(self, "seconds")


if __name__ == "__main__":
    run_benchmark("benchmarks.baselines", Options, lambda chosen: run(chosen.seconds), __doc__)
