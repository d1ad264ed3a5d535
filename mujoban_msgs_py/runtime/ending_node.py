"""A node that is over once it was destroyed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.timer import Timer


class EndingNode(Node):
    """A node that does nothing once it was destroyed.

    An `EventsExecutor` runs at most one callback in a `spin_once` and keeps the others queued; those of a node that is
    removed and destroyed meanwhile run all the same, on publishers that are gone.

    Attributes:
        ended: Whether it was destroyed; callbacks of subscriptions ask for it themselves.
    """

    ended = False

    def destroy_node(self) -> None:
        """End the node; what an executor still has in its queue for it is left alone."""
        self.ended = True
        super().destroy_node()

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], object], *args: Any, **options: Any
    ) -> Timer:
        """Make a timer as `rclpy.node.Node` does; it stands still once the node was destroyed."""

        def call() -> None:
            if not self.ended:
                callback()

        return super().create_timer(timer_period_sec, call, *args, **options)
