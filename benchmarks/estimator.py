"""How long a step of state estimator and control termination takes, and how fast training data is read and used.

``python -m benchmarks.estimator`` prints milliseconds and rates as JSON; with ``--bags`` also the rate at which frames
are read from them. Times of steps and reading are processor time of one thread, so that other work on the machine
hardly changes them; training is timed by the clock, at its quickest, as two shards share its work.
"""

from __future__ import annotations

import time
import timeit
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.command import run_benchmark
from benchmarks.timing import milliseconds
from mujoban_core.bodies import BALL
from mujoban_core.interfaces import EstimatorInput, TerminationInput
from mujoban_estimator.bag_stream import TOPICS, stretches
from mujoban_estimator.data import Batch
from mujoban_estimator.estimator import StateEstimator
from mujoban_estimator.learner import EstimatorLearner, TrainConfig
from mujoban_estimator.termination import ControlTermination
from mujoban_msgs_py.bags.training import ReadReport, find_bags, open_training_bag
from mujoban_rl.limits import NaNGuard

TICKS = 256
"""Of a training step."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    repeats: int = 200
    bags: tuple[Path, ...] = ()
    """Bags, or folders of bags, to read."""
    training_steps: int = 10


def step_times(repeats: int) -> dict[str, float]:
    """Return the time of one step with batch 1; the estimator's is that of a step that takes in the frame."""
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
    estimator, termination = StateEstimator(update_every=1).eval(), ControlTermination().eval()
    seen = EstimatorInput(frame, np.zeros((1, 3), np.float32))
    felt = TerminationInput(frame, np.zeros((1, BALL.proprio_size), np.float32), np.array([1]), np.array([False]))
    belief, memory = estimator.initial_memory(1), termination.initial_memory(1)
    return {
        "estimator_step_ms": milliseconds(lambda: estimator.step(seen, belief), repeats),
        "termination_step_ms": milliseconds(lambda: termination.probability(felt, memory), repeats),
    }


def training_seconds(steps: int, shards: int, streams: int = 4) -> float:
    """Return the wall-clock of a training step with `TICKS` ticks, without reading them."""
    ticks = TICKS // streams
    rng, guard = np.random.default_rng(0), NaNGuard()
    learner = EstimatorLearner(TrainConfig(streams=streams, length=ticks, shards=shards))
    state = np.zeros((streams, ticks, 10, 10, 4), np.float32)
    state[..., 5, 5, 2] = 1.0
    flags = np.zeros((streams, ticks), np.bool_)
    views = np.ones((streams, ticks, 10, 10), np.bool_)
    batch = Batch(
        rng.integers(0, 256, (streams, ticks, 64, 64, 3), dtype=np.uint8),
        rng.uniform(-3, 3, (streams, ticks, 3)).astype(np.float32),
        np.zeros((streams, ticks, BALL.proprio_size), np.float32),
        np.ones((streams, ticks), np.int64), np.arange(ticks) % 25 == flags, flags, state,
        ~flags, flags[:, 0], views, views,
    )  # fmt: skip

    def step() -> None:
        learner.update(batch, 0.5, guard)

    step()
    return min(timeit.repeat(step, number=1, repeat=steps))


def reading_rate(bags: tuple[Path, ...]) -> float:
    """Return the frames read from bags, ready to train on, per second."""
    report = ReadReport()
    start = time.process_time()
    for path in find_bags(bags):
        for _ in stretches(open_training_bag(path, TOPICS), 64, report, allow_test_seeds=True):
            pass
    return report.ticks / (time.process_time() - start)


def measure(options: Options) -> dict[str, float]:
    """Return times of steps and rates of training and reading."""
    torch.set_num_threads(1)
    seconds, divided = (training_seconds(options.training_steps, shards) for shards in (1, 2))
    rates = {"training_ticks_per_s": TICKS / seconds, "two_shards_ratio": seconds / divided}
    result = {**step_times(options.repeats), **rates}
    if options.bags:
        result["bag_frames_per_s"] = reading_rate(options.bags)
    return {name: round(value, 3) for name, value in result.items()}


if __name__ == "__main__":
    run_benchmark("benchmarks.estimator", Options, measure, __doc__)
