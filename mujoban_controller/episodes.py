"""Which levels the goal task plays: those of consecutive seeds to judge, random ones to learn."""

from __future__ import annotations

import numpy as np

from mujoban_sokoban.episodes import EpisodeSpec, after_moves
from mujoban_sokoban.generator import draw_training_seeds, generate_level
from mujoban_sokoban.solver import solve_level


class SeededEpisodes:
    """Episodes of consecutive seeds at one difficulty."""

    def __init__(self, difficulty: int, first_seed: int) -> None:
        """Start with the level of `first_seed`."""
        self._difficulty, self._seed = difficulty, first_seed

    def __call__(self) -> EpisodeSpec:
        """Return the next episode."""
        seed = self._seed
        self._seed += 1
        return EpisodeSpec(generate_level(self._difficulty, seed), seed)


class TrainingEpisodes:
    """Levels whose seeds are drawn from `TRAIN_SEEDS`, each at a random point of its solution."""

    def __init__(self, difficulty: int, rng: np.random.Generator, *, max_nodes: int) -> None:
        """Draw from `rng`; levels whose solution takes a search of more than `max_nodes` begin at their start."""
        self._difficulty, self._rng, self._max_nodes = difficulty, rng, max_nodes

    def __call__(self) -> EpisodeSpec:
        """Return the next episode."""
        seed = draw_training_seeds(self._rng, 1)[0]
        level = generate_level(self._difficulty, seed)
        moves = solve_level(level, max_nodes=self._max_nodes).moves
        done = int(self._rng.integers(len(moves))) if len(moves) else 0
        return EpisodeSpec(after_moves(level, moves[:done]), seed)
