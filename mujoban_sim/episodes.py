"""Which episodes are played: generated levels or those of a file, one seed per episode."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import overload

from mujoban_sim.generator import generate_level
from mujoban_sim.grid import DIFFICULTIES
from mujoban_sim.levels import Level, read_levels
from mujoban_sim.world import EpisodeSpec


class Episodes(Sequence[EpisodeSpec]):
    """A run of episodes: episode i has seed `seed + i`.

    Its level is generated from that seed or, with a level file, is number i of the file, which starts
    over after its last level. Levels are made when they are first asked for.
    """

    def __init__(
        self, count: int | None, seed: int, *, difficulty: int = max(DIFFICULTIES), level_file: Path | None = None
    ) -> None:
        """Describe the run.

        Args:
            count: Number of episodes; None means one, or every level of the file.
            seed: Seed of episode 0, not negative.
            difficulty: 1 to 5, for generated levels.
            level_file: Levels in the Boxoban format.

        Raises:
            ValueError: If an argument is out of its range.
            LevelError: If the level file is malformed.
            OSError: If it cannot be read.
        """
        if difficulty not in DIFFICULTIES:
            raise ValueError(f"unknown difficulty {difficulty}: expected one of {', '.join(map(str, DIFFICULTIES))}")
        if seed < 0:
            raise ValueError(f"seed {seed} is negative: expected an integer from 0")
        if count is not None and count < 1:
            raise ValueError(f"{count} episodes: expected at least 1")
        self.level_file = level_file
        self.levels = None if level_file is None else tuple(read_levels(level_file))
        self.seed = seed
        self._difficulty = difficulty
        self._count = count if count is not None else len(self.levels or (None,))
        self._made: dict[int, EpisodeSpec] = {}

    @property
    def difficulty(self) -> int:
        """Difficulty of generated levels; 0 stands for levels from a file."""
        return self._difficulty if self.levels is None else 0

    @cached_property
    def max_boxes(self) -> int:
        """Most boxes that any level of the run has."""
        if self.levels is None:
            return DIFFICULTIES[self._difficulty][1]
        return max(len(level.boxes) for level in self.levels)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return self._count

    @overload
    def __getitem__(self, index: int) -> EpisodeSpec: ...
    @overload
    def __getitem__(self, index: slice) -> list[EpisodeSpec]: ...
    def __getitem__(self, index: int | slice) -> EpisodeSpec | list[EpisodeSpec]:
        """Return one episode, or several."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        if index not in self._made:
            self._made[index] = EpisodeSpec(self._level(index), self.seed + index)
        return self._made[index]

    def _level(self, index: int) -> Level:
        if self.levels is None:
            return generate_level(self._difficulty, self.seed + index)
        return self.levels[index % len(self.levels)]
