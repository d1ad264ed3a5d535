"""Say only now and then what happens again and again, at no cost in between."""

from __future__ import annotations

import time
from typing import Final
from weakref import WeakKeyDictionary

from rclpy.node import Node

LOG_PERIOD: Final = 5.0
"""Seconds between two reports of the same kind."""

_said: WeakKeyDictionary[Node, dict[str, float]] = WeakKeyDictionary()


def is_due(node: Node, kind: str, period: float = LOG_PERIOD) -> bool:
    """Tell whether a node may report something again, and note that it does.

    The loggers' own `throttle_duration_sec` looks up who calls, on disk, whenever it is asked: 0.3 ms for each message
    of a flood, in which the run stands still.

    Args:
        node: Who reports.
        kind: What is reported; one of few, so without what differs from one time to the next.
        period: Seconds between two reports.
    """
    said, now = _said.setdefault(node, {}), time.monotonic()
    if now - said.get(kind, -period) < period:
        return False
    said[kind] = now
    return True
