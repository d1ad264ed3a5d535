"""Nodes of the graph end, go by wall time, and refuse what they cannot answer."""

import time
from collections import Counter

import pytest
import rclpy
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterEvent, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter

from mujoban_msgs_py.runtime.graph_node import GraphNode

TIMERS = 5
"""So many are due at once; `spin_once` runs one of them."""


def test_timers_that_an_executor_has_queued_stand_still_once_their_node_is_destroyed(ros):
    executor, node = EventsExecutor(), GraphNode("short")
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


@pytest.mark.parametrize(("kind", "name"), [(SetParameters, "set_parameters"),
                                            (SetParametersAtomically, "set_parameters_atomically")])  # fmt: skip
def test_a_parameter_of_no_type_is_refused_by_name_and_what_came_before_it_is_set(ros, capfd, kind, name):
    executor, node, other = EventsExecutor(), GraphNode("steadfast"), rclpy.create_node("other")
    node.counts = Counter()
    node.declare_parameter("speed", 1)
    for each in (node, other):
        executor.add_node(each)
    client = other.create_client(kind, f"/steadfast/{name}")
    sound = Parameter("speed", value=2).to_parameter_msg()
    request = kind.Request(parameters=[sound, ParameterMessage(name="speed", value=ParameterValue(type=77)), sound])

    def answer():
        future = client.call_async(request)
        end = time.monotonic() + 10
        while not future.done() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        return future.result()

    assert client.wait_for_service(10)
    response = answer()
    if kind is SetParameters:
        assert [result.successful for result in response.results] == [True, False, False]
        assert "77" in response.results[1].reason and node.get_parameter("speed").value == 2
    else:
        assert not response.result.successful and node.get_parameter("speed").value == 1
    assert node.counts["rejected messages"] == 1
    assert f"rejected a message on /steadfast/{name}: 77 is not a valid Parameter.Type" in capfd.readouterr().err
    executor.shutdown()
    for each in (node, other):
        each.destroy_node()  # or later tests would discover it


def test_timers_go_on_by_wall_time_though_there_is_no_simulated_time(ros):
    executor, node = EventsExecutor(), GraphNode("timed", parameter_overrides=[Parameter("use_sim_time", value=True)])
    called = []
    node.create_timer(0.01, lambda: called.append(1))
    executor.add_node(node)
    end = time.monotonic() + 10
    while len(called) < 3 and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)
    assert len(called) >= 3
    executor.shutdown()
