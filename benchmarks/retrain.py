"""Retrain as a user does, against the clock: `python -m benchmarks.retrain`, 20 minutes on two cores.

A pair of estimator and termination is left weak on purpose. It runs the stack and is recorded; a new pair is trained
from those bags, starting from the weak one; both are judged on other levels, in the stack and on held-out bags. The
commands are those of docs/estimator.md, "From a running stack to better weights", and are printed as they run.
"""

from __future__ import annotations

import json
import resource
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_benchmark
from mujoban_core.plugins import ROLES
from mujoban_sokoban.generator import VALIDATION_SEEDS

PAIR = ("estimator", "termination")


@dataclass(frozen=True)
class Options:
    """What is done; the times of recording and training are what a user waits for."""

    run: Path = Path("runs/retrain")
    """New folder for bags and weights."""
    difficulty: int = 3
    weak_episodes: int = 16
    """Episodes, recorded with the oracles, that the weak pair learns from."""
    weak_steps: int = 200
    episodes: int = 200
    """Episodes that are recorded with the weak pair."""
    steps: int = 1400
    """Steps of the schedule of the retraining."""
    seconds: float = 480.0
    """Longest time of the retraining."""
    threads: int = 1
    levels: int = 48
    """Levels on which both pairs are judged."""


def execute(*arguments: str | Path | float) -> float:
    """Run a Python command, show it, and return the seconds it took.

    Raises:
        subprocess.CalledProcessError: If it fails.
    """
    command = [str(argument) for argument in arguments]
    print(f"python {shlex.join(command)}", flush=True)
    start = time.monotonic()
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - start


def pair_options(folder: Path) -> list[str | Path]:
    """Return the options that name a pair of weights."""
    return [part for role in PAIR for part in (f"--{role}", folder / f"{role}.safetensors")]


def judge(weights: Path, held_out: Path, options: Options) -> dict[str, Any]:
    """Return the success rate in the stack and the rates on held-out bags."""
    stack, bags = weights / "stack.json", weights / "bags.json"
    execute(
        "bringup/evaluate.py", "--difficulty", options.difficulty, "--episodes", options.levels,
        "--seed", VALIDATION_SEEDS.start,
        *pair_options(weights), "--json", stack,
    )  # fmt: skip
    execute("-m", "mujoban_estimator.evaluate", "--bags", held_out, *pair_options(weights), "--json", bags)
    report, rates = json.loads(stack.read_text()), json.loads(bags.read_text())
    kept = ("box_recall_in_view", "boxes_all_right_if_seen", "wall_accuracy_seen", "termination_recall")
    solved = {key: report[key] for key in ("success_rate", "success_interval")}
    return {"n": options.levels, **solved, **{key: rates[key] for key in kept}}


def run(options: Options) -> dict[str, Any]:
    """Return the seconds of each step, the memory of the largest process in GiB, and what both pairs reach.

    Raises:
        FileExistsError: If the folder exists.
    """
    options.run.mkdir(parents=True)
    first, own, held_out = (options.run / name for name in ("first", "own", "held_out"))
    weak, better = options.run / "weak", options.run / "better"
    oracles = ("--oracle", ",".join(ROLES))
    record = ("bringup/record.py", "--difficulty", options.difficulty, "--time-limit", 500, "--processes", 2)
    train = ("-m", "mujoban_estimator.train", "--threads", options.threads)
    execute(*record, "--out", first, "--episodes", options.weak_episodes, "--seed", 40_000_000, *oracles)
    execute(*record, "--out", held_out, "--episodes", 16, "--seed", VALIDATION_SEEDS.start + 500_000, *oracles)
    execute(
        *train, "--bags", first, "--run", options.run / "train_weak", "--out", weak,
        "--steps", options.weak_steps,
    )  # fmt: skip
    seconds = {
        "record": execute(
            *record, "--out", own, "--episodes", options.episodes, "--seed", 41_000_000, *pair_options(weak)
        ),
        "train": execute(
            *train, "--bags", own, "--start", weak, "--run", options.run / "train_better", "--out", better,
            "--steps", options.steps, "--seconds", options.seconds,
        ),
    }  # fmt: skip
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    pairs = {name: judge(folder, held_out, options) for name, folder in (("weak", weak), ("retrained", better))}
    return {"seconds": seconds, "largest_process_gib": largest, **pairs}


if __name__ == "__main__":
    run_benchmark("benchmarks.retrain", Options, run, __doc__)
