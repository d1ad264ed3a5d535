"""Speed of the planner: latency of one decision and training throughput, as JSON (`python benchmarks/planner.py`)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks.command import run_benchmark
from mujoban_core.threads import set_threads
from mujoban_planner import SHIPPED, load
from mujoban_planner.abstract_env import AbstractEnvironment
from mujoban_planner.boards import BitBoards, abstract_states, bit_boards, state_tensor
from mujoban_planner.export import export
from mujoban_planner.imitation import ImitationConfig, imitation_loss
from mujoban_planner.lessons import LessonMaker
from mujoban_planner.networks import RecurrentPlanner
from mujoban_planner.planner import LearnedPlanner, split_memory
from mujoban_planner.push_env import PushEnvironment
from mujoban_planner.samples import SampleBuffer, make_batch
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.teacher import Teacher
from mujoban_rl.precision import autocast
from mujoban_rl.weights import save_weights
from mujoban_sokoban.generator import TRAIN_SEEDS, VALIDATION_SEEDS, generate_batch


@dataclass(frozen=True)
class Options:
    """What to measure, and for how long."""

    seconds: float = 3.0
    """Seconds per measurement."""
    device: str = "cpu"
    """Device of training and of the abstract environment; decisions are measured on the CPU."""
    threads: int = 1
    """Threads on a CPU."""


def rate(step: Callable[[], object], seconds: float, device: str = "cpu") -> float:
    """Return calls per second after a warm-up."""
    for _ in range(3):
        step()
    _wait(device)
    start, calls = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        step()
        calls += 1
    _wait(device)
    return calls / (time.perf_counter() - start)


def decision_milliseconds(planner: LearnedPlanner, seconds: float) -> dict[str, float]:
    """Return median, 99th percentile and maximum of the time of one decision for one robot, ms."""
    states, memory = abstract_states(generate_batch(5, VALIDATION_SEEDS[:16])), planner.initial_memory(1)

    def decide(count: int) -> None:
        nonlocal memory
        _, memory = planner.decide(states[count % 16][None], memory)

    return _milliseconds(decide, seconds)


def thinking_milliseconds(thinking: int, seconds: float) -> dict[str, float]:
    """Return the same of the planner that ships with more thinking in the network."""
    planner = load(SHIPPED)
    planner.thinking = thinking
    return decision_milliseconds(planner, seconds)


def all_sides_milliseconds(thinking: int, seconds: float) -> dict[str, float]:
    """Return the same of it where a decision looks from all sides, as before a doubtful push."""
    planner = load(SHIPPED)
    planner.thinking, planner.doubt = thinking, -1.0  # whatever is said of it
    states = abstract_states(generate_batch(5, VALIDATION_SEEDS[:128]))
    _, memory = planner.decide(states, planner.initial_memory(len(states)))
    _, means = split_memory(memory)
    states = states[means.views == planner.perspectives]  # those in which a push is decided on
    if not len(states):
        raise RuntimeError("a planner that begins no level with a push, expected some of 128 to be begun so")

    def decide(count: int) -> None:
        planner.decide(states[count % len(states)][None], planner.initial_memory(1))

    return _milliseconds(decide, seconds)


def _milliseconds(decide: Callable[[int], None], seconds: float) -> dict[str, float]:
    """Return median, 99th percentile and maximum of the time of calls with their number, but for the first five."""
    times: list[float] = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds or len(times) <= 5:
        before = time.perf_counter()
        decide(len(times))
        times.append(1e3 * (time.perf_counter() - before))
    median, tail, most = np.percentile(times[5:], [50, 99, 100])
    return {"median_ms": float(median), "p99_ms": float(tail), "max_ms": float(most)}


def exported(planner: LearnedPlanner) -> LearnedPlanner:
    """Return the planner with its decision as a graph, as planners that ship have it, where this can be exported."""
    if find_spec("onnxscript") is None:
        return planner.eval()
    with TemporaryDirectory() as folder:
        weights = Path(folder) / "planner.safetensors"
        save_weights(weights, planner, planner.config, {})
        export(weights)
        return load(weights)


def training_samples_per_second(config: ImitationConfig, options: Options) -> float:
    """Return imitation samples per second, forward and backward, on ready samples."""
    network = config.build().to(options.device)
    adam = torch.optim.AdamW(network.parameters(), 1e-4, fused=True)
    buffer = SampleBuffer(50_000)
    buffer.add(LessonMaker(0, {5: 1.0}).demonstrations(64))
    rng = np.random.default_rng(0)

    def step() -> None:
        batch = make_batch(buffer.draw(config.batch_size, rng), rng.integers(0, SYMMETRIES, config.batch_size))
        with autocast(options.device):
            loss, _ = imitation_loss(network, batch.to(options.device), config)
        adam.zero_grad()
        loss.backward()
        adam.step()

    return config.batch_size * rate(step, options.seconds, options.device)


def environment_steps_per_second(options: Options, batch: int = 4096) -> float:
    """Return instructions per second of the abstract environment."""
    environment = AbstractEnvironment(batch, device=options.device)
    states = torch.from_numpy(abstract_states(generate_batch(5, VALIDATION_SEEDS[:batch])))
    environment.reset_to(torch.arange(batch), states)
    instruction = torch.randint(1, 5, (batch,), generator=torch.Generator().manual_seed(0)).to(options.device)
    return batch * rate(lambda: environment.step(instruction), options.seconds, options.device)


def pushes_per_cpu_second(options: Options, batch: int = 1024) -> float:
    """Return pushes per CPU second of the environment of pushes: masks, steps, resets and abstract states."""
    environment, boards = PushEnvironment(batch), bit_boards(generate_batch(5, VALIDATION_SEEDS[:batch]))
    environment.reset_to(np.arange(batch), boards)
    rng, calls, spent = np.random.default_rng(0), 0, 0.0
    while spent < options.seconds:
        start = time.process_time()
        possible = environment.possible()
        state_tensor(environment.boards)
        spent += time.process_time() - start
        push = (rng.random(possible.shape, dtype=np.float32) * possible).argmax(1)
        start = time.process_time()
        over = np.flatnonzero(environment.step(push).over)
        environment.reset_to(over, BitBoards._make(column[over] for column in boards))
        spent = spent + time.process_time() - start if calls else 0.0  # the first call compiles
        calls += 1
    return batch * (calls - 1) / spent


def demonstrations_per_second(options: Options) -> float:
    """Return labelled levels per second and core, generation included."""
    teacher, rng, seeds = Teacher(), np.random.default_rng(0), itertools.count(TRAIN_SEEDS.start, 64)

    def step() -> None:
        first = next(seeds)
        teacher.demonstrate(generate_batch(5, range(first, first + 64)), rng)

    return 64 * rate(step, options.seconds)


def measure(options: Options) -> dict[str, Any]:
    """Return the figures."""
    set_threads(options.threads)
    shipped = load(SHIPPED)
    return {
        "decision": {
            f"shipped ({type(shipped).__name__})": decision_milliseconds(shipped, options.seconds),
            "RecurrentPlanner": decision_milliseconds(exported(RecurrentPlanner()), options.seconds),
            "shipped, without its graph": decision_milliseconds(load(SHIPPED, compiled=False), options.seconds),
            "shipped, thinking 2": thinking_milliseconds(2, options.seconds),
            "shipped, thinking 4": thinking_milliseconds(4, options.seconds),
            "shipped, from all eight sides": all_sides_milliseconds(1, options.seconds),
            "shipped, thinking 4, from all eight sides": all_sides_milliseconds(4, options.seconds),
        },
        "training_samples_per_second": {
            "residual 64x8": training_samples_per_second(ImitationConfig(), options),
            "residual 48x8": training_samples_per_second(ImitationConfig(channels=48), options),
            "recurrent 32, DRC(3,3)": training_samples_per_second(
                ImitationConfig(architecture="recurrent", channels=32, propagation=False), options
            ),
        },
        "environment_steps_per_second": environment_steps_per_second(options),
        "pushes_per_cpu_second": pushes_per_cpu_second(options),
        "demonstrated_levels_per_second": demonstrations_per_second(options),
        "device": options.device,
        "threads": options.threads,
        "torch": torch.__version__,
    }


def _wait(device: str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    run_benchmark("benchmarks.planner", Options, measure)
