"""Streams training data from recorded bags with bounded memory (see `mujoban_msgs_py.bags`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from mujoban_core.interfaces import NO_INSTRUCTION
from mujoban_estimator.data import Stretch
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError, open_bag
from mujoban_msgs_py.bags.metadata import FILE_NAME
from mujoban_msgs_py.conversions import EpisodeReading
from mujoban_sokoban.generator import TEST_SEEDS

TOPICS: Final = (
    topics.EPISODE,
    topics.CAMERA,
    topics.POSE,
    topics.PROPRIO,
    topics.INSTRUCTION,
    topics.TERMINATION,
    topics.TRUE_ABSTRACT_STATE,
    topics.TRUE_TERMINATION,
)
"""What training needs of a bag."""


def find_bags(folders: Sequence[Path]) -> list[Path]:
    """Return the bags among the given paths: each is a bag, or a folder of bags.

    Raises:
        BagError: if there is none at a path.
    """
    found: list[Path] = []
    for folder in folders:
        if not folder.exists():
            raise BagError(f"no bag at {folder}: expected a bag or a folder of bags")
        if folder.is_file() or (folder / FILE_NAME).exists() or _has_files(folder):
            found.append(folder)
            continue
        below = sorted(p for p in folder.iterdir() if p.is_dir() and ((p / FILE_NAME).exists() or _has_files(p)))
        if not below:
            raise BagError(f"no bag in {folder}: expected folders with {FILE_NAME}, .mcap or .db3 files")
        found += below
    return found


def _has_files(folder: Path) -> bool:
    return any(folder.glob("*.mcap")) or any(folder.glob("*.db3"))


def open_checked(path: Path, *, skip_damaged: bool = False) -> Bag:
    """Open a bag that has every topic that training needs.

    Args:
        path: The bag.
        skip_damaged: Leave damaged chunks out instead of refusing the bag.

    Raises:
        BagError: if a topic is missing, by name, or the bag is damaged and that is not to be skipped.
    """
    bag = open_bag(path, damaged="skip" if skip_damaged else "refuse")
    missing = [t.name for t in TOPICS if t.name not in bag.topics or bag.topics[t.name].count == 0]
    if missing:
        raise BagError(f"{path} lacks {', '.join(missing)}: expected a bag with {', '.join(t.name for t in TOPICS)}")
    return bag


@dataclass
class ReadReport:
    """What reading met with."""

    ticks: int = 0
    episodes: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    """Ticks that were left out, by reason."""
    test_seeds: set[int] = field(default_factory=set)
    """Seeds of episodes that are kept for tests."""


class _Episode:
    """Gathers the ticks of an episode into stretches."""

    def __init__(self, reading: EpisodeReading) -> None:
        self.reading = reading
        self.next_step = 0
        self.instruction, self.terminated = NO_INSTRUCTION, False
        self.first = True
        self.rows: list[tuple[Any, ...]] = []

    def add(self, values: tuple[Any, ...]) -> None:
        _, frame, pose, proprio, instruction, termination, abstract_state, label = values
        self.rows.append((frame, pose, proprio, self.instruction, self.terminated, label.terminated, abstract_state))
        self.instruction, self.terminated = instruction.direction, termination.terminated
        self.next_step += 1

    def take(self) -> Stretch:
        """Return what has been gathered and forget it."""
        columns = [np.stack(c) if isinstance(c[0], np.ndarray) else np.array(c) for c in zip(*self.rows, strict=True)]
        stretch = Stretch._make([*columns, self.first])
        self.rows, self.first = [], False
        return stretch


def stretches(bag: Bag, length: int, report: ReadReport) -> Iterator[Stretch]:
    """Yield the episodes of a bag in stretches of `length` ticks; the last of an episode may be shorter.

    An episode is used from its first tick on, up to a tick that is missing: without it nobody can tell what the
    modules remember. What is left out for that is counted in `report`.
    """
    episode: _Episode | None = None
    for tick in bag.ticks(TOPICS):
        reading: EpisodeReading = tick.values[0]
        if reading.step == 0:
            if episode is not None and episode.rows:
                yield episode.take()
            episode = _Episode(reading)
            report.episodes += 1
            if reading.seed in TEST_SEEDS:
                report.test_seeds.add(reading.seed)
        if episode is None:
            report.skipped["of an episode whose start is missing"] += 1
            continue
        if reading.episode != episode.reading.episode or reading.step != episode.next_step:
            report.skipped["behind a gap"] += 1
            if episode.rows:
                yield episode.take()
            episode = None
            continue
        episode.add(tick.values)
        report.ticks += 1
        if len(episode.rows) == length:
            yield episode.take()
    if episode is not None and episode.rows:
        yield episode.take()


class BagStream(Iterator[Stretch]):
    """The stretches of all bags, one bag after the other in an order that is drawn anew each time, for ever."""

    def __init__(
        self,
        paths: Sequence[Path],
        length: int,
        rng: np.random.Generator,
        report: ReadReport | None = None,
        *,
        skip_damaged: bool = False,
        allow_test_seeds: bool = False,
    ) -> None:
        """Read stretches of `length` ticks from `paths`; `rng` draws the order."""
        self._paths, self._length, self._rng = list(paths), length, rng
        self._report = report or ReadReport()
        self._skip_damaged, self._allow_test_seeds = skip_damaged, allow_test_seeds
        self._begin_round()

    def _begin_round(self) -> None:
        self._drawn_from = self._rng.bit_generator.state
        self._order = self._rng.permutation(len(self._paths)).tolist()
        self._bag, self._taken = 0, 0
        self._before = self._report.ticks
        self._reader: Iterator[Stretch] | None = None

    def __next__(self) -> Stretch:
        """Return the next stretch.

        Raises:
            BagError: As `open_checked`, if no bag holds a whole tick, or if one holds an episode with a seed that is
                kept for tests and that is not allowed.
        """
        while True:
            if self._bag == len(self._order):
                if self._report.ticks == self._before:
                    raise BagError(
                        f"none of {len(self._paths)} bags holds an episode from its start: nothing to learn from"
                    )
                self._begin_round()
            path = self._paths[self._order[self._bag]]
            if self._reader is None:
                bag = open_checked(path, skip_damaged=self._skip_damaged)
                self._reader = stretches(bag, self._length, self._report)
            stretch = next(self._reader, None)
            if self._report.test_seeds and not self._allow_test_seeds:
                raise BagError(
                    f"{path} holds an episode with seed {min(self._report.test_seeds)}, which is kept for tests: "
                    f"expected seeds from {TEST_SEEDS.stop} on, or --allow-test-seeds"
                )
            if stretch is not None:
                self._taken += 1
                return stretch
            self._bag, self._taken, self._reader = self._bag + 1, 0, None

    def state(self) -> dict[str, Any]:
        """Return where the stream is: JSON values."""
        return {"drawn_from": self._drawn_from, "bag": self._bag, "taken": self._taken}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from where a stream of the same bags was, which reads the last bag again up to there."""
        self._rng.bit_generator.state = state["drawn_from"]
        self._begin_round()
        self._bag = state["bag"]
        for _ in range(state["taken"]):
            next(self)
