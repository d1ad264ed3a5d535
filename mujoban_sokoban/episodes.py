"""Which episodes are played: generated levels or those of a file, one seed per episode."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np

from mujoban_core.grid import DIFFICULTIES
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.levels import Level, read_levels
from mujoban_sokoban.rules import apply


@dataclass(frozen=True)
class EpisodeSpec:
    """What fixes an episode: the level, and the seed of initial heading and appearance."""

    level: Level
    seed: int


def after_moves(level: Level, moves: Iterable[int]) -> Level:
    """Return the level as it is after instructions were executed by the rules."""
    boxes, player = level.boxes, np.array(level.player)
    for move in moves:
        boxes, player, *_ = apply(level.wall, level.target, boxes, player, int(move))
    return replace(level, boxes=boxes, player=(int(player[0]), int(player[1])))


class LazyEpisodes(Sequence[EpisodeSpec]):
    """Numbered episodes, each made when it is first asked for."""

    def __init__(self, count: int) -> None:
        """Number `count` episodes from 0."""
        self._count = count
        self._made: dict[int, EpisodeSpec] = {}

    @abstractmethod
    def _make(self, index: int) -> EpisodeSpec:
        """Return episode `index`; called once for each."""

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
            self._made[index] = self._make(index)
        return self._made[index]


class Episodes(LazyEpisodes):
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
        super().__init__(count if count is not None else len(self.levels or (None,)))

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

    def _make(self, index: int) -> EpisodeSpec:
        seed = self.seed + index
        if self.levels is None:
            return EpisodeSpec(generate_level(self._difficulty, seed), seed)
        return EpisodeSpec(self.levels[index % len(self.levels)], seed)
