"""Exact-stamp join: hands over the items of all topics of a tick once the last of them has arrived."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Synchroniser(Generic[Item]):
    """Joins items of several topics by equal stamp, with bounded memory.

    Topics are ordered, so a tick that is completed shows that older ones never will be: they are dropped, as is
    one of more than `depth` unfinished ticks: the one with the fewest items, which is none of the simulator's when
    somebody floods a topic, and of these the oldest. Age is that of arrival, so that time may jump back, as when a bag
    is played again.

    Attributes:
        dropped: Items that were received and never handed over, counted by topic.
    """

    def __init__(self, topics: Sequence[str], depth: int = 8) -> None:
        """Join these topics and keep at most `depth` unfinished ticks.

        Raises:
            ValueError: If there is no topic, one is named twice, or `depth` is not positive.
        """
        if not topics or len(set(topics)) != len(topics):
            raise ValueError(f"topics must be one or more distinct names, got {list(topics)}")
        if depth < 1:
            raise ValueError(f"depth must be at least 1, got {depth}")
        self.topics = tuple(topics)
        self.depth = depth
        self.dropped: Counter[str] = Counter()
        self._known = frozenset(topics)
        self._unfinished: dict[Hashable, dict[str, Item]] = {}

    def __len__(self) -> int:
        """Return the number of unfinished ticks."""
        return len(self._unfinished)

    def add(self, topic: str, stamp: Hashable, item: Item) -> dict[str, Item] | None:
        """Add an item; a second one of the same topic and stamp takes the place of the first.

        Returns:
            The tick's items by topic if this was the last one missing, else None.

        Raises:
            KeyError: If the topic is not one of those to join.
        """
        if topic not in self._known:
            raise KeyError(f"unknown topic {topic!r}: expected one of {', '.join(self.topics)}")
        items = self._unfinished.setdefault(stamp, {})
        items[topic] = item
        if len(items) < len(self.topics):
            if len(self._unfinished) > self.depth:
                others = [other for other in self._unfinished if other != stamp]
                self._drop(min(others, key=lambda other: len(self._unfinished[other])))
            return None
        while (oldest := next(iter(self._unfinished))) != stamp:
            self._drop(oldest)
        return self._unfinished.pop(stamp)

    def clear(self) -> None:
        """Drop all unfinished ticks, and count them."""
        while self._unfinished:
            self._drop(next(iter(self._unfinished)))

    def _drop(self, stamp: Hashable) -> None:
        self.dropped.update(self._unfinished.pop(stamp).keys())
