"""How fast levels are generated and solved, and how they compare with Boxoban's.

``python -m benchmarks.levels`` prints rates as JSON; ``--statistics 5000`` the statistics of that many generated levels
of difficulty 5 beside those of Boxoban's unfiltered set. Rates are per second of processor time of one thread, after
compilation, so that other work on the machine hardly changes them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.command import run_benchmark
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.stats import wilson_interval
from mujoban_sokoban.generator import VALIDATION_SEEDS, generate_batch, generate_levels
from mujoban_sokoban.levels import LevelBatch
from mujoban_sokoban.solver import MAX_NODES, Status, demonstrations, label_states, solve_batch

PERCENTILES: Final = (5, 25, 50, 75, 95)

BOXOBAN_UNFILTERED: Final[dict[str, list[float]]] = {
    "floor cells": [21, 27, 32, 36, 42],
    "open neighbours of a floor cell": [2.55, 2.76, 2.89, 3.0, 3.15],
    "walls next to a box": [0, 0.25, 0.5, 0.75, 1],
    "Manhattan distance of a box to the nearest target": [1.25, 1.5, 1.75, 2.25, 3],
}
"""`PERCENTILES` over 5,000 levels; all but the first are means over a level's cells or boxes."""
BOXOBAN_SOLUTION: Final = {"moves": 32, "pushes": 13}
"""Means of nearly optimal solutions of the same set."""
NEARLY_OPTIMAL: Final = 2.0
"""Weight of the searches that count as nearly optimal: 2 % longer than optimal solutions."""


@dataclass(frozen=True)
class Options:
    """How much to measure."""

    levels: int = 1000
    """Levels of difficulty 5 to time."""
    statistics: int = 0
    """Levels of difficulty 5 to compare with Boxoban's instead of timing; 0 for timing."""


def level_statistics(batch: LevelBatch) -> dict[str, NDArray[np.float64]]:
    """Return the figures of `BOXOBAN_UNFILTERED` of every level, [B] each."""
    floor = ~batch.wall
    neighbours = np.zeros(floor.shape, np.int64)
    neighbours[:, 1:] += floor[:, :-1]
    neighbours[:, :-1] += floor[:, 1:]
    neighbours[:, :, 1:] += floor[:, :, :-1]
    neighbours[:, :, :-1] += floor[:, :, 1:]
    cells = floor.sum((1, 2))
    level = np.arange(len(floor))[:, None]
    walls = 4 - neighbours[level, batch.boxes[..., 0], batch.boxes[..., 1]]
    targets = np.argwhere(batch.target)[:, 1:].reshape(*batch.boxes.shape)
    # Shape [B, K, K]: from each box to each target.
    distance = np.abs(batch.boxes[:, :, None] - targets[:, None]).sum(-1)
    values = (cells, (neighbours * floor).sum((1, 2)) / cells, walls.mean(1), distance.min(-1).mean(1))
    return {name: np.asarray(value, np.float64) for name, value in zip(BOXOBAN_UNFILTERED, values, strict=True)}


def statistics(count: int) -> dict[str, Any]:
    """Return the statistics of `count` generated levels of difficulty 5, for validation, beside Boxoban's."""
    batch = generate_batch(5, VALIDATION_SEEDS[:count])
    table = {
        name: {"generated": np.percentile(values, PERCENTILES).round(2).tolist(), "boxoban": BOXOBAN_UNFILTERED[name]}
        for name, values in level_statistics(batch).items()
    }
    result: dict[str, Any] = {"levels": count, "percentiles": PERCENTILES, "table": table}
    for name, weight in (("nearly optimal", NEARLY_OPTIMAL), ("optimal", 1.0)):
        found = solve_batch(batch, weight=weight)
        solved = found.status == Status.SOLVED
        result[name] = {
            "solved": int(solved.sum()),
            "moves": round(float(found.length[solved].mean()), 2),
            "pushes": round(float(found.pushes[solved].mean()), 2),
            "moves_percentiles": np.percentile(found.length[solved], PERCENTILES).tolist(),
            "pushes_percentiles": np.percentile(found.pushes[solved], PERCENTILES).tolist(),
            "nodes": round(float(found.nodes.mean())),
        }
    return {**result, "boxoban nearly optimal": BOXOBAN_SOLUTION}


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return a function's result and the processor seconds that it took."""
    start = time.thread_time()
    result = function()
    return result, time.thread_time() - start


def run(options: Options | None = None) -> dict[str, Any]:
    """Measure generator and solver on levels of difficulty 5, one thread.

    Returns:
        Levels per second generated (also as `Level` objects and at the other difficulties), solved optimally and
        nearly so, turned into demonstrations, and judged as single states; the share that the optimal search solves
        with its 95 % Wilson interval; and states searched per level.
    """
    options = options or Options()
    count, seeds = options.levels, VALIDATION_SEEDS[: options.levels]
    rng = np.random.default_rng(0)
    for weight in (1.0, NEARLY_OPTIMAL):  # compiles
        demonstrations(generate_batch(5, VALIDATION_SEEDS[:2]), rng=rng, weight=weight)
    batch, seconds = _timed(lambda: generate_batch(5, seeds))
    result: dict[str, Any] = {"levels_generated_per_second": count / seconds}
    result["level_objects_generated_per_second"] = count / _timed(lambda: generate_levels(5, seeds))[1]
    for difficulty in range(1, max(DIFFICULTIES)):
        _, seconds = _timed(lambda difficulty=difficulty: generate_batch(difficulty, seeds))
        result[f"levels_of_difficulty_{difficulty}_generated_per_second"] = count / seconds
    found, seconds = _timed(lambda: solve_batch(batch))
    solved = int((found.status == Status.SOLVED).sum())
    result |= {
        "levels_solved_optimally_per_second": count / seconds,
        "success_rate": solved / count,
        "success_interval": wilson_interval(solved, count),
        "max_nodes": MAX_NODES,
        "nodes_per_level": float(found.nodes.mean()),
    }
    result["levels_solved_nearly_optimally_per_second"] = (
        count / _timed(lambda: solve_batch(batch, weight=NEARLY_OPTIMAL))[1]
    )
    shown, seconds = _timed(lambda: demonstrations(batch, rng=rng))
    result |= {
        "levels_demonstrated_per_second": count / seconds,
        "states_demonstrated_per_second": len(shown.level) / seconds,
    }
    result["states_labelled_per_second"] = count / _timed(lambda: label_states(_states(batch, shown, rng)))[1]
    return result


def _states(batch: LevelBatch, shown: Any, rng: np.random.Generator) -> LevelBatch:
    """Return as many states from anywhere on the demonstrated solutions as there are levels."""
    rows = rng.integers(0, len(shown.level), len(batch.wall))
    level = shown.level[rows]
    size = batch.wall.shape[1]
    boxes, player = (
        np.stack(np.divmod(cells[rows].astype(np.int64), size), -1) for cells in (shown.boxes, shown.player)
    )
    return LevelBatch(batch.wall[level], batch.target[level], boxes, player)


if __name__ == "__main__":
    run_benchmark(
        "benchmarks.levels", Options,
        lambda chosen: statistics(chosen.statistics) if chosen.statistics else run(chosen), __doc__,
    )  # fmt: skip
