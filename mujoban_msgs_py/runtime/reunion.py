"""What a node that was killed and came back waits for: those who only watch, and ask for nothing twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from mujoban_msgs_py.listening import NAMELESS, node_of
from mujoban_msgs_py.topics import PUBLISHERS

PERIOD: Final = 0.02
"""Seconds between two looks at whether all are back."""
PATIENCE: Final = 2.5
"""Seconds for which a node waits at most, once it is back: who watched may have left."""
_GRAPH: Final = frozenset(f"/{name}" for name in PUBLISHERS.values())
"""Nodes of the graph. They take part in every tick, and those that were killed stay known for a while."""


class Watchers:
    """Counts who reads what a node publishes without being a node of the graph, such as the monitor or a view."""

    def __init__(self, node: Node, publishers: Sequence[Publisher]) -> None:
        """Watch over these publishers of the node."""
        self.publishers = tuple(publishers)
        self._node = node
        self._known = [(0, 0)] * len(self.publishers)

    def count(self) -> NDArray[np.int64]:
        """Return their number for each publisher, [n]."""
        return np.array([self._count(index) for index in range(len(self.publishers))], np.int64)

    def _count(self, index: int) -> int:
        publisher = self.publishers[index]
        readers, watchers = self._known[index]
        if (now := publisher.get_subscription_count()) != readers:
            names = [node_of(info) for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name)]
            watchers = sum(name not in _GRAPH and name != NAMELESS for name in names)
            if NAMELESS not in names:
                self._known[index] = now, watchers
        return watchers


class Reunion:
    """Holds back a node that came back until all who watched it before hear it again, or had time to.

    Discovery takes up to some seconds, and is not over at the same time on both sides. Before a reader is known here
    it is sent nothing; a reader that does not know this writer yet is sent all of it again, but no more than the queue
    holds. So the node says one thing once all are known here, and the next when that has been acknowledged.
    """

    def __init__(
        self, node: Node, watchers: Watchers, expected: NDArray[np.int64], again: Callable[[], object]
    ) -> None:
        """Wait for as many as there were.

        Args:
            node: The one that came back.
            watchers: Who reads what it publishes now.
            expected: How many there were, `Watchers.count`.
            again: Called over and over until nothing is held back any more.

        Raises:
            ValueError: If `expected` is not of these watchers.
        """
        if expected.shape != (len(watchers.publishers),):
            raise ValueError(f"expected watchers of {len(watchers.publishers)} topics, found {expected.shape}")
        self._watchers, self._expected = watchers, expected
        self._timer = node.create_timer(PERIOD, self._look)
        self._again = again
        self._deadline = time.monotonic() + PATIENCE
        self._spoken = self._over = False

    def lets_speak(self) -> bool:
        """Tell whether the node may publish now; after the first time it is taken to have done so."""
        if self._over:
            return True
        if not self._spoken:
            self._spoken = self._late or bool((self._watchers.count() >= self._expected).all())
            return self._spoken
        heard = all(publisher.wait_for_all_acked(Duration()) for publisher in self._watchers.publishers)
        self._over = heard or self._late
        return self._over

    @property
    def _late(self) -> bool:
        return time.monotonic() > self._deadline

    def _look(self) -> None:
        if self._over or self._late:
            self._timer.cancel()
        self._again()


def may_speak(reunion: Reunion | None) -> bool:
    """Tell whether a node may publish: one that did not come back waits for nobody."""
    return reunion is None or reunion.lets_speak()
