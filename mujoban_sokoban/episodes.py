"""Which episodes are played: generated levels or those of a file, one seed per episode."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, overload
from weakref import WeakValueDictionary

import numpy as np

from mujoban_core.grid import DIFFICULTIES
from mujoban_sokoban.generator import PLAY_SEEDS, check_difficulty, check_seed, generate_level
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


@dataclass(frozen=True)
class LevelSource:
    """Turns an episode's seed into its level: a generated one, or one of a file.

    Attributes:
        difficulty: 1 to 5, of generated levels.
        levels: Levels of a file; the episode with seed s plays number s modulo their count. Empty: generate.
    """

    difficulty: int
    levels: tuple[Level, ...] = ()

    @classmethod
    def make(cls, difficulty: int, level_file: str | PathLike[str] | None) -> LevelSource:
        """Check the options and read the file, which is in the Boxoban format.

        Raises:
            ValueError: If the difficulty is unknown or the file is malformed or empty.
            OSError: If it cannot be read.
        """
        check_difficulty(difficulty)
        return cls(difficulty, () if level_file is None else tuple(read_levels(level_file)))

    @property
    def max_boxes(self) -> int:
        """The most boxes of any level."""
        return max((len(level.boxes) for level in self.levels), default=DIFFICULTIES[self.difficulty][1])

    def episode(self, seed: int) -> EpisodeSpec:
        """Return the episode with a given seed."""
        if self.levels:
            return EpisodeSpec(self.levels[seed % len(self.levels)], seed)
        return EpisodeSpec(generate_level(self.difficulty, seed), seed)


class LazyEpisodes(Sequence[EpisodeSpec]):
    """Numbered episodes, each made when it is asked for, and kept while somebody plays it."""

    def __init__(self, count: int) -> None:
        """Number `count` episodes from 0."""
        self._count = count
        # Episodes that are over go: kept among what a world allocates and frees, they would hold all of it.
        self._made: WeakValueDictionary[int, EpisodeSpec] = WeakValueDictionary()

    @abstractmethod
    def _make(self, index: int) -> EpisodeSpec:
        """Return episode `index`, the same whenever it is made."""

    def number(self, index: int) -> int:
        """Return the number of episode `index` within its run, from 1 on: modules' random streams depend on it."""
        return index + 1

    def __getstate__(self) -> dict[str, Any]:
        """Return all but what was made."""
        return {name: value for name, value in vars(self).items() if name != "_made"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over what `__getstate__` returned."""
        vars(self).update(state, _made=WeakValueDictionary())

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
        made = self._made.get(index)
        if made is None:
            made = self._made[index] = self._make(index)
        return made


class Episodes(LazyEpisodes):
    """A run of episodes: episode i has seed `seed + i`, and the level that `LevelSource` has for that seed.

    Levels are made when they are first asked for.
    """

    def __init__(
        self,
        count: int | None,
        seed: int | None,
        *,
        difficulty: int = max(DIFFICULTIES),
        level_file: Path | None = None,
        seeds: range | None = None,
    ) -> None:
        """Describe the run.

        Args:
            count: Number of episodes; None means one, or as many as a level file has levels.
            seed: Seed of episode 0, not negative; None: the first of `seeds`, or that plays a file's first level.
            difficulty: 1 to 5, for generated levels.
            level_file: Levels in the Boxoban format.
            seeds: Those to begin with where no seed is given; None: `PLAY_SEEDS`, or of a file all from 0 on.

        Raises:
            ValueError: If an argument is out of its range.
            LevelError: If the level file is malformed.
            OSError: If it cannot be read.
        """
        self.source = LevelSource.make(difficulty, level_file)
        if seed is None:
            levels = len(self.source.levels)
            first = (0 if levels else PLAY_SEEDS.start) if seeds is None else seeds.start
            seed = first + (-first % levels if levels else 0)
        check_seed(seed)
        if count is not None and count < 1:
            raise ValueError(f"{count} episodes: expected at least 1")
        self.level_file = level_file
        self.seed = seed
        self.first_number = 1
        """Number of the first episode; another one where these are a part of a longer run."""
        super().__init__(count if count is not None else max(len(self.source.levels), 1))

    def number(self, index: int) -> int:
        """Return the number of an episode within the run that these are a part of."""
        return self.first_number + index

    @property
    def difficulty(self) -> int:
        """Difficulty of generated levels; 0 stands for levels from a file."""
        return 0 if self.source.levels else self.source.difficulty

    @property
    def max_boxes(self) -> int:
        """Most boxes that any level of the run has."""
        return self.source.max_boxes

    @property
    def seeds(self) -> range:
        """Seeds of the episodes, in their order."""
        return range(self.seed, self.seed + len(self))

    def _make(self, index: int) -> EpisodeSpec:
        return self.source.episode(self.seeds[index])


def check_levels(episodes: Sequence[EpisodeSpec], max_boxes: int) -> None:
    """Reject levels with too many boxes.

    Raises:
        ValueError: if there is one.
    """
    for level in (episode.level for episode in episodes):
        if len(level.boxes) > max_boxes:
            raise ValueError(
                f"level {level.name!r} has {len(level.boxes)} boxes: expected at most max_boxes = {max_boxes}"
            )
