"""Streams training data from recorded bags, which are kept within a bound of memory (see `mujoban_msgs_py.bags`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mujoban_core.interfaces import NO_INSTRUCTION
from mujoban_core.memory import available_memory
from mujoban_estimator.data import Stretch
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError
from mujoban_msgs_py.bags.training import ReadReport, episode_ticks, open_training_bag

TOPICS: Final = (
    topics.TRUE_EPISODE,
    topics.CAMERA,
    topics.POSE,
    topics.PROPRIO,
    topics.INSTRUCTION,
    topics.TERMINATION,
    topics.TRUE_ABSTRACT_STATE,
    topics.TRUE_TERMINATION,
)
"""What training needs of a bag."""
_KEPT_SHARE: Final = 1 / 3
"""Of the memory that is available: what the bags take which a training keeps, by default."""


class _Episode:
    """Gathers the ticks of an episode into stretches."""

    def __init__(self) -> None:
        self.instruction, self.terminated = NO_INSTRUCTION, False
        self.first = True
        self.rows: list[tuple[Any, ...]] = []

    def add(self, values: tuple[Any, ...]) -> None:
        _, frame, pose, proprio, instruction, termination, abstract_state, label = values
        self.rows.append((frame, pose, proprio, self.instruction, self.terminated, label.terminated, abstract_state))
        self.instruction, self.terminated = instruction.direction, termination.terminated

    def take(self) -> Stretch:
        """Return what has been gathered and forget it."""
        columns = [np.stack(c) if isinstance(c[0], np.ndarray) else np.array(c) for c in zip(*self.rows, strict=True)]
        stretch = Stretch._make([*columns, self.first])
        self.rows, self.first = [], False
        return stretch


def stretches(
    bag: Bag, length: int, report: ReadReport, *, allow_test_seeds: bool = False
) -> Iterator[Stretch]:
    """Yield the episodes of a bag in stretches of `length` ticks; the last of an episode may be shorter.

    What is left out is counted in `report`.

    Raises:
        BagError: As `episode_ticks`.
    """
    episode = _Episode()
    for reading, values in episode_ticks(bag, TOPICS, report, allow_test_seeds=allow_test_seeds):
        if reading.step == 0:
            if episode.rows:
                yield episode.take()
            episode = _Episode()
        episode.add(values)
        if len(episode.rows) == length:
            yield episode.take()
    if episode.rows:
        yield episode.take()


class KeptBags:
    """Stretches of bags that have been read to their end, for the rounds to come: reading costs much."""

    def __init__(self, limit: int | None = None) -> None:
        """Keep bags, the first that are read, up to so many bytes in all; the others are read again.

        A tick has some 14 KB. The limit is by default a third of the memory that is available.
        """
        self._bags: dict[Path, list[Stretch]] = {}
        self._free = int(_KEPT_SHARE * available_memory()) if limit is None else limit

    def get(self, path: Path) -> list[Stretch] | None:
        """Return the stretches of a bag that is kept."""
        return self._bags.get(path)

    def keep(self, path: Path, gathered: list[Stretch]) -> None:
        """Keep all stretches of a bag if there is room."""
        for _ in self.keeping(path, iter(gathered)):
            pass

    def keeping(self, path: Path, reader: Iterator[Stretch]) -> Iterator[Stretch]:
        """Yield what a reader of a bag yields, and keep it from its end on if there is room."""
        gathered, size, fits = [], 0, True
        for stretch in reader:
            more = sum(values.nbytes for values in stretch if isinstance(values, np.ndarray))
            fits = fits and more <= self._free
            # What is being gathered counts, so that streams side by side stay within the limit together.
            if fits:
                gathered.append(stretch)
                size, self._free = size + more, self._free - more
            else:
                gathered.clear()
                size, self._free = 0, self._free + size
            yield stretch
        if fits and path not in self._bags:
            self._bags[path] = gathered
        else:
            self._free += size


class BagStream(Iterator[Stretch]):
    """The stretches of all bags, one bag after the other in an order that is drawn anew each time, for ever."""

    def __init__(
        self,
        paths: Sequence[Path],
        length: int,
        rng: np.random.Generator,
        kept: KeptBags | None = None,
        *,
        skip_damaged: bool = False,
        allow_test_seeds: bool = False,
    ) -> None:
        """Read stretches of `length` ticks from `paths`; `rng` draws the order; streams may share what is `kept`."""
        self._paths, self._length, self._rng = list(paths), length, rng
        self._kept = KeptBags() if kept is None else kept
        self._skip_damaged, self._allow_test_seeds = skip_damaged, allow_test_seeds
        self._begin_round()

    def _begin_round(self) -> None:
        self._drawn_from = self._rng.bit_generator.state
        self._order = self._rng.permutation(len(self._paths)).tolist()
        self._bag, self._taken = 0, 0
        self._found = False
        self._reader: Iterator[Stretch] | None = None

    def __next__(self) -> Stretch:
        """Return the next stretch.

        Raises:
            BagError: As `open_training_bag` and `episode_ticks`, or if no bag holds a whole tick.
        """
        while True:
            if self._bag == len(self._order):
                if not self._found:
                    raise BagError(
                        f"none of {len(self._paths)} bags holds an episode from its start: nothing to learn from"
                    )
                self._begin_round()
            path = self._paths[self._order[self._bag]]
            if self._reader is None:
                self._reader = self._open(path)
            stretch = next(self._reader, None)
            if stretch is not None:
                self._found, self._taken = True, self._taken + 1
                return stretch
            self._bag, self._taken, self._reader = self._bag + 1, 0, None

    def _open(self, path: Path) -> Iterator[Stretch]:
        kept = self._kept.get(path)
        if kept is not None:
            return iter(kept)
        bag = open_training_bag(path, TOPICS, skip_damaged=self._skip_damaged)
        reader = stretches(bag, self._length, ReadReport(), allow_test_seeds=self._allow_test_seeds)
        return self._kept.keeping(path, reader)

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
