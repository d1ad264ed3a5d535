"""Speed of the world beside the plain loop of MuJoCo steps that bounds it, and its stability over random torques.

``run`` measures all contestants in turns, several times, so that what else the machine does hits them alike; ratios
are medians over the rounds. ``python -m benchmarks.world`` prints it as JSON; ``--random-steps 10_000_000`` adds the
test of stability.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import gymnasium
import mujoco
import numpy as np

import mujoban_sim  # noqa: F401 - registers the environment
from benchmarks.command import run_benchmark
from benchmarks.timing import rate
from mujoban_core.grid import xy_to_cell
from mujoban_sim.scene import SceneCache
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

BATCH = 64
THREADS = 2
SEED = 1
_CHUNK = 200


@dataclass(frozen=True)
class Options:
    """What to measure."""

    seconds: float = 0.5
    """Time for each contestant in each round."""
    rounds: int = 15
    """How often each one is measured."""
    random_steps: int = 0
    """Environment steps with random torques in which to look for anything that leaves the grid."""


def _plain_loop(actions: np.ndarray) -> Callable[[], int]:
    """Return a function that steps the scene of an episode as MuJoCo's tutorial does; the limit of the others."""
    world = World(1)
    world.reset([0], list(Episodes(1, SEED)))
    model = SceneCache(world.body, world.max_boxes, world.preset).model(world.wall[0])
    data = mujoco.MjData(model)
    data.qpos[:] = world.qpos[0]

    def advance() -> int:
        for action in actions:
            data.ctrl[:] = action
            for _ in range(world.preset.substeps):
                mujoco.mj_step(model, data)
        return len(actions)

    return advance


def _single(actions: np.ndarray) -> Callable[[], int]:
    env = gymnasium.make("Mujoban-v0", observations="state", time_limit=10**9, disable_env_checker=True)
    env.reset(seed=SEED)

    def advance() -> int:
        for action in actions:
            env.step(action)
        return len(actions)

    return advance


def _vector(actions: np.ndarray) -> Callable[[], int]:
    env = gymnasium.make_vec(
        "Mujoban-v0",
        BATCH,
        vectorization_mode="vector_entry_point",
        observations="state",
        threads=THREADS,
    )
    env.reset(seed=SEED)

    def advance() -> int:
        for action in actions[: max(1, _CHUNK // BATCH)]:
            env.step(np.broadcast_to(action, (BATCH, 2)))
        return BATCH * max(1, _CHUNK // BATCH)

    return advance


def random_torques(steps: int, batch: int = 512, threads: int = THREADS) -> dict[str, float]:
    """Drive `batch` robots with random torques and count what leaves the free cells of its level.

    Returns:
        Steps made (all robots together), robots and boxes found in a wall or outside the grid, the largest speed of
        a robot and of a box [m/s], and steps per second.
    """
    world = World(batch, threads=threads, time_limit=steps)
    world.reset(np.arange(batch), list(Episodes(batch, SEED)))
    rng = np.random.default_rng(SEED)
    rows = np.arange(batch)
    torque = np.zeros((batch, world.body.action_size), np.float32)
    escaped, robot_speed, box_speed = 0, 0.0, 0.0
    ticks = -(-steps // batch)
    start = time.perf_counter()
    for tick in range(ticks):
        if tick % 10 == 0:
            # Torques that last and are often extreme push boxes hardest.
            torque = np.clip(rng.normal(0.0, 1.5, torque.shape), -1.0, 1.0).astype(np.float32)
        world.step(torque)
        robot, box = xy_to_cell(world.pose[:, :2]), xy_to_cell(world.box_position)
        escaped += int(world.wall[rows, robot[:, 0], robot[:, 1]].sum())
        escaped += int(world.wall[rows[:, None], box[..., 0], box[..., 1]].sum())
        robot_speed = max(robot_speed, float(np.abs(world.velocity[:, :2]).max()))
        box_speed = max(box_speed, float(world.box_speed.max()))
    return {
        "random_steps": ticks * batch,
        "escaped": escaped,
        "largest_robot_speed": robot_speed,
        "largest_box_speed": box_speed,
        "random_steps_per_second": ticks * batch / (time.perf_counter() - start),
    }


def run(options: Options | None = None) -> dict[str, float]:
    """Measure the world.

    Returns:
        Environment steps per second of the plain loop (a call of ``mj_step`` for each physics step), of the Gymnasium
        environment without camera and of the vectorised one on 2 threads; their ratios to the plain loop; and the
        machine's load before (1 minute mean of waiting and running processes).
    """
    options = options or Options()
    load = os.getloadavg()[0]
    actions = np.random.default_rng(SEED).uniform(-1.0, 1.0, (_CHUNK, 2)).astype(np.float32)
    contestants = {"plain": _plain_loop(actions), "env": _single(actions), "vector_env": _vector(actions)}
    rates: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(options.rounds):
        for name, function in contestants.items():
            rates[name].append(rate(function, options.seconds))
    result = {f"{name}_steps_per_second": statistics.median(values) for name, values in rates.items()}
    for name in ("env", "vector_env"):
        ratios = [ours / plain for ours, plain in zip(rates[name], rates["plain"], strict=True)]
        result[f"{name}_ratio"] = statistics.median(ratios)
    if options.random_steps:
        result |= random_torques(options.random_steps)
    return {**result, "load": load}


if __name__ == "__main__":
    run_benchmark("benchmarks.world", Options, lambda chosen: {"options": asdict(chosen), **run(chosen)}, __doc__)
