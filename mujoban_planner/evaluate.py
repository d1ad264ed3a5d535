"""Evaluate a planner under the abstract rules: `python -m mujoban_planner.evaluate --difficulty 5 --episodes 1000`."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mujoban_core.files import check_file, digest
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_not_negative
from mujoban_core.reports import keep_report
from mujoban_core.stats import wilson_interval
from mujoban_core.threads import set_threads
from mujoban_planner import SHIPPED, load
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import take_levels
from mujoban_planner.deliberation import Deliberation
from mujoban_planner.lookahead import LookAheadPlanner
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.play import play
from mujoban_rl.sealed_levels import noted_use
from mujoban_sokoban.generator import VALIDATION_SEEDS, generate_batch, seed_range
from mujoban_sokoban.levels import LevelBatch, read_levels, stack_levels
from mujoban_sokoban.solver import Status, solve_batch

PROG = "mujoban_planner.evaluate"

_CHUNK = 1024
"""Levels played at once."""


@dataclass(frozen=True)
class Options:
    """Play levels with a planner; an episode has at most 120 moves."""

    levels: Path | None = None
    """Boxoban text file; generated levels otherwise."""
    difficulty: int = 5
    """Difficulty of generated levels, 1 to 5."""
    episodes: int = 1000
    """Levels played; all of a file when 0."""
    seed: int = VALIDATION_SEEDS.start
    """Seed of the first generated level; the next ones follow."""
    thinking: int | None = None
    """Repeats, per decision, of the recurrent core, relative to training, or of a thinking network's last blocks, or
    symmetric views of the residual network; the network's own by default."""
    caution: float | None = None
    """Weight of the verdicts on pushes in a decision; the planner's own by default."""
    look_ahead: int = 0
    """Network evaluations of a search under the abstract rules, at most; 0 for none."""
    weights: Path = SHIPPED
    """Weights with their record."""
    optimal: bool = True
    """Moves are compared with optimal solutions, unless --no-optimal is given."""
    device: str = "cpu"
    """Device of the network."""
    threads: int = 1
    """Threads of the network on a CPU."""
    json: Path | None = None
    """Where the figures are written."""

    def __post_init__(self) -> None:
        """Reject thinking less than once or too long, verdicts that repel, and fewer than no levels."""
        check_counts(self, "episodes", least=0)
        if self.thinking is not None:
            check_counts(self, "thinking")
        if self.caution is not None:
            check_not_negative(self, "caution")
        Deliberation(self.thinking or 0, self.look_ahead)  # refuses what nodes refuse

    def level_batch(self) -> LevelBatch:
        """Return the levels.

        Raises:
            ValueError: If an option is out of range or the file holds no levels.
        """
        if self.levels is not None:
            levels = read_levels(self.levels)
            return stack_levels(levels[: self.episodes or None])
        if self.difficulty not in DIFFICULTIES:
            raise ValueError(f"difficulty {self.difficulty}: expected one of {', '.join(map(str, DIFFICULTIES))}")
        if self.episodes < 1:
            raise ValueError(f"{self.episodes} episodes: expected at least 1")
        if seed_range(self.seed, self.episodes) == "training":
            raise ValueError(f"seed {self.seed}: expected seeds of validation or test, not of training")
        return generate_batch(self.difficulty, range(self.seed, self.seed + self.episodes))


def evaluate(planner: LearnedPlanner, levels: LevelBatch, options: Options) -> dict[str, Any]:
    """Return the figures of a planner on levels."""
    if options.thinking is not None:
        planner.thinking = options.thinking
    if options.caution is not None:
        planner.caution = options.caution
    player = LookAheadPlanner(planner, options.look_ahead) if options.look_ahead else planner
    start = time.perf_counter()
    # In chunks, so that memory stays small whatever the number of levels.
    parts = np.array_split(np.arange(len(levels.player)), -(-len(levels.player) // _CHUNK))
    games = [play(player, take_levels(levels, rows)) for rows in parts]
    elapsed = time.perf_counter() - start
    moves = np.concatenate([game.moves for game in games])
    solved = moves >= 0
    decisions = sum(game.decisions for game in games)
    low, high = wilson_interval(int(solved.sum()), len(moves))
    result: dict[str, Any] = {
        "n": len(moves),
        "success_rate": float(solved.mean()),
        "success_interval": [low, high],
        "mean_moves": float(moves[solved].mean()) if solved.any() else None,
        "move_limit": MOVE_LIMIT,
        "decisions_per_second": decisions / elapsed,
        "architecture": type(planner).__name__,
        "thinking": planner.thinking,
        "caution": planner.caution,
        "look_ahead": options.look_ahead,
        "levels": str(options.levels) if options.levels else None,
        "difficulty": None if options.levels else options.difficulty,
        "seed": None if options.levels else options.seed,
        "weights": {"planner": digest(options.weights)},
    }
    if isinstance(player, LookAheadPlanner):
        result["evaluations_per_level"] = player.evaluations / len(moves)
    if options.optimal and solved.any():
        solutions = solve_batch(take_levels(levels, solved))
        known = solutions.status == Status.SOLVED
        if optimal := int(solutions.length[known].sum()):  # else none is known
            result["moves_over_optimal"] = float(moves[solved][known].sum() / optimal)
    return result


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    check_file("--json", options.json)
    set_threads(options.threads)
    levels = options.level_batch()
    planner = load(options.weights, options.device)
    result = evaluate(planner, levels, options)
    if options.levels is None:
        how = {name: result[name] for name in ("difficulty", "thinking", "caution", "look_ahead")}
        seeds = range(options.seed, options.seed + options.episodes)
        result |= noted_use(seeds, result["weights"], {"program": PROG, **how})
    keep_report(result, options.json)  # before anything is printed, which nobody may read any more
    low, high = result["success_interval"]
    print(f"success rate          {result['success_rate']:.4f}  [{low:.4f}, {high:.4f}]  n = {result['n']}")
    if "moves_over_optimal" in result:
        print(f"moves over optimal    {result['moves_over_optimal']:.3f}")
    print(f"decisions per second  {result['decisions_per_second']:.0f}")
    if options.look_ahead:
        print(f"evaluations per level {result['evaluations_per_level']:.1f}  (at most {options.look_ahead} per search)")
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
