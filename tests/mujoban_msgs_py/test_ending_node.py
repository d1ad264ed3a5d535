"""A node that was destroyed does nothing more."""

from rcl_interfaces.msg import ParameterEvent
from rclpy.experimental import EventsExecutor

from mujoban_msgs_py.runtime.ending_node import EndingNode

TIMERS = 5
"""So many are due at once; `spin_once` runs one of them."""


def test_timers_that_an_executor_has_queued_stand_still_once_their_node_is_destroyed(ros):
    executor, node = EventsExecutor(), EndingNode("short")
    publisher = node.create_publisher(ParameterEvent, "events", 1)
    called = []
    for _ in range(TIMERS):
        node.create_timer(0.01, lambda: called.append(publisher.get_subscription_count()))
    executor.add_node(node)
    while not called:
        executor.spin_once(timeout_sec=0.05)
    executor.remove_node(node)
    node.destroy_node()
    done = len(called)
    for _ in range(TIMERS):
        executor.spin_once(timeout_sec=0.02)  # a publisher that is gone raises InvalidHandle
    assert len(called) == done
    executor.shutdown()
