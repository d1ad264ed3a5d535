"""Frames per second of one actor and of two: in threads, in processes and on Ray, on the cores of this machine.

The workload is that of a learner from the camera: in every tick the robots' world is drawn, the controller's network
acts with noise, physics steps, and what was seen goes to the learner's process in sequences. Nothing learns, so that
both cores are the actors'; weights are published after every sequence of each actor.

Contestants take turns for several rounds, so that what else the machine does hits them alike; each one's median
counts. ``python -m benchmarks.actors`` prints JSON, with what `docs/cluster.md` computes a plan for many actors from.
"""

from __future__ import annotations

import os
import statistics
import time
from dataclasses import asdict, dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.command import run_benchmark
from benchmarks.plan import Measured, plan
from mujoban_controller.controller import VisuomotorController
from mujoban_core.interfaces import ControllerInput
from mujoban_rl.actors import Actor, ActorOptions, ActorPool, Experience
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import TRAIN_SEEDS, draw_training_seeds, generate_level

_KINDS: Final = ("threads", "processes", "ray")


@dataclass(frozen=True)
class CameraActors:
    """Makes actors that drive at random from camera frames."""

    batch: int = 16
    """Robots."""
    length: int = 16
    """Ticks of a sequence."""
    levels: int = 32
    """Levels that an actor plays over and over."""

    def __call__(self, stream: int) -> CameraActor:
        """Return an actor for a random stream."""
        return CameraActor(self, stream)


class CameraActor(Actor):
    """Robots that the camera controller drives by random instructions."""

    def __init__(self, config: CameraActors, stream: int) -> None:
        """Begin an episode in every row."""
        self._config = config
        self._rng = np.random.default_rng([TRAIN_SEEDS.start, stream])
        seeds = draw_training_seeds(self._rng, config.levels)
        self._pool = [EpisodeSpec(generate_level(5, seed), seed) for seed in seeds]
        self._world = World(config.batch)
        self._policy = VisuomotorController().eval()
        self._memory = self._policy.initial_memory(config.batch)
        self._instruction = np.zeros(config.batch, np.int64)
        self._renew(np.arange(config.batch))

    def set_weights(self, weights: dict[str, Tensor], version: int) -> None:
        """Take over the controller's weights."""
        self._policy.load_state_dict(weights)

    def act(self) -> Experience:
        """Play a sequence of every robot."""
        ticks = [self._tick() for _ in range(self._config.length)]
        arrays = {name: np.stack([tick[name] for tick in ticks]) for name in ticks[0]}
        return Experience(arrays, self._config.length * self._config.batch, {"reward": arrays["reward"].sum(0)})

    def close(self) -> None:
        """Free the cameras."""
        self._world.close()

    def _tick(self) -> dict[str, np.ndarray]:
        world, rng, batch = self._world, self._rng, self._config.batch
        changed = rng.random(batch) < 0.05
        self._instruction[changed] = rng.integers(1, 5, int(changed.sum()))
        seen = {"frame": world.render(), "proprio": world.proprio.copy(), "instruction": self._instruction.copy()}
        inputs = ControllerInput(seen["instruction"], seen["frame"], seen["proprio"], changed)
        torque, self._memory = self._policy.step(inputs, self._memory)
        torque = np.clip(torque + rng.normal(0.0, 0.3, torque.shape), -1.0, 1.0).astype(np.float32)
        world.step(torque)
        over = world.done | (rng.random(batch) < 0.005)
        played = {**seen, "action": torque, "reward": world.reward.copy(), "over": over}
        if over.any():
            self._renew(np.flatnonzero(over))
        return played

    def _renew(self, rows: np.ndarray) -> None:
        self._world.reset(rows, [self._pool[i] for i in self._rng.integers(len(self._pool), size=len(rows))])


class Rate(NamedTuple):
    """How fast a pool was."""

    frames_per_second: float
    frames_per_cpu_second: float
    """Of the actors' processes, which other work on the machine hardly changes."""
    cpu_seconds_per_frame_here: float
    """Of the learner's process, to receive what actors play in others."""


class Contestant:
    """A pool that is measured for some seconds at a time."""

    def __init__(self, kind: str, actors: int, config: CameraActors) -> None:
        """Start the pool, and wait until each actor has played."""
        self.pool: ActorPool = ActorOptions(kind, actors, schedule="first").pool(config)  # type: ignore[arg-type]
        self._weights = VisuomotorController().state_dict()
        self._version = 0
        for _ in range(2 * actors):
            self._collect()
        self.bytes = sum(array.nbytes for array in self._collect().arrays.values())
        """Size of a sequence."""

    def _collect(self) -> Experience:
        if self._version % self.pool.count == 0:
            self.pool.publish(self._weights, self._version)
        self._version += 1
        return self.pool.collect()

    def rate(self, seconds: float) -> Rate:
        """Measure; what was played between two measurements is left out."""
        for _ in range(self.pool.count):
            self._collect()
        start, cpu = time.perf_counter(), time.process_time()
        frames, actors_cpu = 0, 0.0
        while time.perf_counter() - start < seconds:
            experience = self._collect()
            frames += experience.steps
            actors_cpu += experience.cpu_seconds
        here = time.process_time() - cpu
        return Rate(frames / (time.perf_counter() - start), frames / actors_cpu, here / frames)


def run(seconds: float = 3.0, rounds: int = 3) -> dict[str, object]:
    """Measure all pools.

    Args:
        seconds: For each contestant in each round.
        rounds: How often each one is measured.

    Returns:
        Frames per second by pool and number of actors (medians over the rounds), the ratios that matter, and a plan
        for a thousand actors.
    """
    load = os.getloadavg()[0]
    torch.set_num_threads(1)
    config = CameraActors()
    rates: dict[str, list[Rate]] = {}
    size = 0
    for _ in range(rounds):
        for kind in _KINDS:
            for actors in (1, 2):
                contestant = Contestant(kind, actors, config)
                rates.setdefault(f"{kind}_{actors}", []).append(contestant.rate(seconds))
                size = contestant.bytes
                contestant.pool.close()
    median = {name: Rate(*map(statistics.median, zip(*values, strict=True))) for name, values in rates.items()}
    weights = sum(tensor.numel() * tensor.element_size() for tensor in VisuomotorController().state_dict().values())
    per_second = {name: rate.frames_per_second for name, rate in median.items()}
    ray = median["ray_2"]
    frame = size / (config.batch * config.length)
    measured = Measured(ray.frames_per_cpu_second, frame, weights, 1e9 / frame * ray.cpu_seconds_per_frame_here)
    return {
        "frames_per_second": per_second,
        **{f"{kind}_2_to_1": per_second[f"{kind}_2"] / per_second[f"{kind}_1"] for kind in _KINDS},
        "ray_overhead": 1.0 - per_second["ray_2"] / per_second["processes_2"],
        # In threads all CPU time is this process's.
        "frames_per_cpu_second": {name: median[name].frames_per_cpu_second for name in ("processes_2", "ray_2")},
        "measured": asdict(measured),
        "thousand_actors": plan(measured, 1000),
        "load": load,
    }


@dataclass(frozen=True)
class Options:
    """What to measure."""

    seconds: float = 3.0
    """For each contestant in each round."""
    rounds: int = 3


if __name__ == "__main__":
    run_benchmark("benchmarks.actors", Options, lambda chosen: run(chosen.seconds, chosen.rounds))
