"""What a node says of itself on /diagnostics: at once to who begins to listen, then once a second (REP 107)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.event_handler import PublisherEventCallbacks

from mujoban_msgs_py.runtime.graph_node import GraphNode

TOPIC: Final = "/diagnostics"
PERIOD: Final = 1.0
"""Seconds between two messages."""
MODULE: Final = "module"
"""Names the figure that says which module a node runs; `mujoban_core.plugins.PRIVILEGED` ends it where that is so."""
WEIGHTS: Final = "weights"
"""Names the figure that says which weights a module has, other than those that ship."""


class Condition(NamedTuple):
    """How a node is."""

    message: str
    """In one line."""
    values: Mapping[str, Any]
    """Figures by name."""
    warning: bool = False


def report_on(node: GraphNode, look: Callable[[], Condition]) -> None:
    """Have a node publish the condition that `look` returns when somebody begins to listen, then every `PERIOD`.

    A run may be over within the first `PERIOD`, and who watched it, or recorded what he saw, is to know who played.
    """

    def publish(_: object = None) -> None:
        if node.ended or publisher.get_subscription_count() == 0:
            return
        condition = look()
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if condition.warning else DiagnosticStatus.OK,
            name=node.get_fully_qualified_name(),
            message=condition.message,
            values=[KeyValue(key=key, value=str(value)) for key, value in condition.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(array)

    begun = PublisherEventCallbacks(matched=publish)
    publisher = node.create_publisher(DiagnosticArray, TOPIC, 10, event_callbacks=begun)
    node.create_timer(PERIOD, publish)
