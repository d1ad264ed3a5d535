"""Frames per second of the robot's camera, and whole environment steps with camera.

``run`` measures all contestants in turns, several times, so that what else the machine does hits them alike, and
reports each one's median. ``python -m benchmarks.rendering`` prints it as JSON.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

# mujoco.Renderer takes its OpenGL from what this says when mujoco is first imported.
os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np

from benchmarks.command import run_benchmark
from benchmarks.timing import rate, work
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.ranges import check_counts, check_positive
from mujoban_sim.presets import DEFAULT_WORLD, EASED
from mujoban_sim.scene import SceneCache
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

BATCH = 64
THREADS = 2
DIFFICULTY = 5


@dataclass(frozen=True)
class Options:
    """Measure."""

    seconds: float = 0.25
    """For each contestant in each round."""
    rounds: int = 20
    """How often each one is measured."""

    def __post_init__(self) -> None:
        """Reject numbers out of their range."""
        check_positive(self, "seconds")
        check_counts(self, "rounds")


def _make_world(threads: int, name: str = DEFAULT_WORLD) -> World:
    episodes = Episodes(BATCH, VALIDATION_SEEDS.start, difficulty=DIFFICULTY)
    world = World(BATCH, world=name, max_boxes=episodes.max_boxes, threads=threads)
    world.reset(np.arange(BATCH), list(episodes))
    world.render()
    return world


def _default_renderer(world: World) -> Callable[[], int]:
    """Return a function that draws one frame of the physics scene as MuJoCo does when it is not told how."""
    model = SceneCache(world.body, world.max_boxes, world.preset).model(world.wall[0])
    data = mujoco.MjData(model)
    data.qpos[:] = world.qpos[0]
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, FRAME_SIZE, FRAME_SIZE)

    def draw() -> int:
        renderer.update_scene(data, "first_person")
        renderer.render()
        return 1

    return draw


def run(options: Options | None = None) -> dict[str, float]:
    """Measure rendering, by default with the default options.

    Returns:
        Rates per second and their ratios to those of MuJoCo's default renderer and of the eased world, whose drawn
        walls are half as high (medians over the rounds), and the machine's load before (1 minute mean of waiting and
        running processes).
    """
    chosen = options or Options()
    load = os.getloadavg()[0]
    one, two, low = _make_world(1), _make_world(THREADS), _make_world(1, EASED.name)
    rng = np.random.default_rng(0)

    def step() -> int:
        two.step(rng.uniform(-1.0, 1.0, (BATCH, two.body.action_size)).astype(np.float32))
        return len(two.render())

    contestants: dict[str, Callable[[], int]] = {
        "default_renderer_frames_per_second": _default_renderer(one),
        "frames_per_second": lambda: len(one.render()),
        "frames_per_second_low_walls": lambda: len(low.render()),
        "frames_per_second_2_threads": lambda: len(two.render()),
        "steps_with_camera_per_second_2_threads": step,
    }
    rates: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(chosen.rounds):
        for name, function in contestants.items():
            rates[name].append(rate(function, chosen.seconds))
    result = {name: statistics.median(values) for name, values in rates.items()}
    start = time.process_time()
    count, _ = work(contestants["frames_per_second"], chosen.seconds)
    result["frames_per_cpu_second"] = count / (time.process_time() - start)
    others = {"default": "default_renderer_frames_per_second", "low_walls": "frames_per_second_low_walls"}
    for name, other in others.items():
        pairs = zip(rates["frames_per_second"], rates[other], strict=True)
        result[f"frames_ratio_to_{name}"] = statistics.median(ours / theirs for ours, theirs in pairs)
    for world in (one, two, low):
        world.close()
    return {**result, "load": load}


if __name__ == "__main__":
    run_benchmark("benchmarks.rendering", Options, run, __doc__)
