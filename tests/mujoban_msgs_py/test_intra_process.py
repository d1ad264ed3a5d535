"""Messages between nodes of one process: handed over while nobody else reads them, sent as soon as somebody does."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from mujoban_msgs.msg import Instruction
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.arrivals import Handed
from mujoban_msgs_py.checks import ConversionError
from mujoban_msgs_py.listening import listen, subscribe
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.intra_process import LATE_JOINER_PERIOD, IntraProcess
from mujoban_msgs_py.runtime.tick_node import live_qos


def pose(tick):
    """Return a pose that tells its tick."""
    return conversions.pose_to_msg(conversions.header(tick * topics.TICK), (float(tick), 0.0, 0.0))


class Company:
    """Nodes on one executor."""

    def __init__(self):
        self.executor = EventsExecutor()
        self.between = IntraProcess()
        self.nodes = []

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def node(self, name):
        return self.add(GraphNode(name, intra_process=self.between))

    def remove(self, node):
        self.nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def reader(self, name, topic=topics.POSE, qos=None):
        """Return a node that reads a topic, and the arrivals that it has noted."""
        arrivals = []
        node = self.node(name)
        subscribe(node, topic, arrivals.append, qos)
        return node, arrivals

    def spin_for(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def spin_until(self, condition):
        deadline = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < deadline, "nothing more comes"
            self.executor.spin_once(timeout_sec=0.02)

    def close(self):
        for node in self.nodes[::-1]:
            self.remove(node)
        self.executor.shutdown()


@pytest.fixture
def company(ros):
    nodes = Company()
    yield nodes
    nodes.close()


def ticks(arrivals):
    return [arrival.stamp // topics.TICK for arrival in arrivals]


def test_all_who_read_a_topic_are_handed_the_message_itself_in_order_and_after_publish(company):
    said, (_, first), (_, second) = company.node("said"), company.reader("first"), company.reader("second")
    output = said.create_output(topics.POSE)
    messages = [pose(tick) for tick in range(1, 4)]
    for message in messages:
        output.publish(message)
    assert first == second == []
    company.spin_until(lambda: len(second) == 3)
    assert ticks(first) == ticks(second) == [1, 2, 3]
    assert [arrival.content(None) for arrival in first] == messages
    assert first[0].content(conversions.pose_from_msg) is second[0].content(conversions.pose_from_msg)


def test_as_soon_as_somebody_else_reads_all_receive_what_is_sent_once(company):
    said, (_, inside) = company.node("said"), company.reader("inside")
    output, outside = said.create_output(topics.POSE), []
    stranger = company.add(Node("stranger"))
    stranger.create_subscription(PoseStamped, topics.POSE.name, outside.append, topics.POSE.qos)
    company.spin_until(lambda: output.subscriptions == 2)
    output.publish(pose(1))
    company.spin_until(lambda: inside and outside)
    company.remove(stranger)
    company.spin_until(lambda: output.subscriptions == 1)
    output.publish(pose(2))
    company.spin_until(lambda: len(inside) == 2)
    assert ticks(inside) == [1, 2] and outside == [pose(1)]
    assert [isinstance(arrival, Handed) for arrival in inside] == [False, True]


def test_who_joins_late_hears_the_latest_message_of_a_latched_topic(company):
    said, (_, inside) = company.node("said"), company.reader("inside", topics.INSTRUCTION)
    output = said.create_output(topics.INSTRUCTION)

    def say(sequence):
        output.publish(conversions.instruction_to_msg(
            conversions.header(sequence * topics.TICK), conversions.InstructionReading(sequence, 3)
        ))

    for latest in (2, 4):  # what a stranger has heard before is kept for nobody
        say(latest - 1)
        say(latest)
        company.spin_until(lambda latest=latest: len(inside) >= latest)
        company.spin_for(3 * LATE_JOINER_PERIOD)
        late: list[Instruction] = []
        stranger = company.add(Node(f"stranger_{latest}"))
        stranger.create_subscription(Instruction, topics.INSTRUCTION.name, late.append, topics.INSTRUCTION.qos)
        company.spin_until(lambda late=late: late)
        assert [message.sequence for message in late] == [latest]
        company.remove(stranger)
        company.spin_until(lambda: output.subscriptions <= 1)


def test_a_reader_that_is_too_slow_loses_the_oldest_and_nobody_else_does(company):
    said = company.node("said")
    (_, slow), (_, patient) = company.reader("slow", qos=live_qos(2)), company.reader("patient", qos=live_qos(50))
    output = said.create_output(topics.POSE)
    for tick in range(1, 51):
        output.publish(pose(tick))
    company.spin_until(lambda: len(patient) == 50)
    assert ticks(patient) == [*range(1, 51)] and ticks(slow) == [49, 50]


def test_a_node_that_has_ended_hears_nothing_and_holds_nobody_up(company):
    (gone, unheard), said, (_, heard) = company.reader("gone"), company.node("said"), company.reader("heard")
    output = said.create_output(topics.POSE)
    output.publish(pose(1))
    company.remove(gone)
    company.spin_until(lambda: heard)
    output.publish(pose(2))
    company.spin_until(lambda: len(heard) == 2)
    assert ticks(heard) == [1, 2] and unheard == []


def test_an_error_of_a_reader_ends_the_spin_and_loses_no_other_message(company):
    said, broken = company.node("said"), company.node("broken")

    def fail(_):
        raise RuntimeError("out of order")

    subscribe(broken, topics.POSE, fail)
    _, heard = company.reader("heard")
    said.create_output(topics.POSE).publish(pose(1))
    with pytest.raises(RuntimeError, match="out of order"):
        company.spin_until(lambda: heard)
    company.spin_until(lambda: heard)
    assert ticks(heard) == [1]


def test_two_nodes_that_answer_each_other_for_ever_let_timers_have_their_turn(company):
    ping, pong, due = company.node("ping"), company.node("pong"), []
    to_pong, to_ping = ping.create_output(topics.POSE), pong.create_output(topics.TRUE_POSE)
    subscribe(pong, topics.POSE, lambda _: to_ping.publish(pose(1)))
    subscribe(ping, topics.TRUE_POSE, lambda _: to_pong.publish(pose(1)))
    ping.create_timer(0.01, lambda: due.append(1))
    to_pong.publish(pose(1))
    company.spin_until(lambda: len(due) == 3)


def test_a_message_of_a_value_that_its_topic_does_not_carry_is_rejected(company):
    said, wary = company.node("said"), company.node("wary")
    heard = []
    listen(wary, topics.POSE, heard.append)
    output, bad = said.create_output(topics.POSE), pose(1)
    bad.pose.orientation.w = 5.0
    output.publish(bad)
    output.publish(pose(2))
    company.spin_until(lambda: heard)
    assert ticks(heard) == [2]


@pytest.mark.parametrize("value", [0.1, 1 / 3])
def test_numbers_are_rounded_where_a_message_is_made_as_they_are_where_it_is_sent(value):
    reading = conversions.TerminationReading(1, value, terminated=False, timed_out=False)
    said = conversions.termination_to_msg(conversions.header(0), reading).probability
    assert said == conversions.termination_value(*reading).probability == float(np.float32(value)) != value


def test_a_probability_above_one_by_less_than_rounding_is_refused():
    header, above = conversions.header(0), 1.0 + 1e-9
    with pytest.raises(ConversionError):
        conversions.termination_value(1, above, terminated=False)
    with pytest.raises(ConversionError):
        conversions.termination_to_msg(header, conversions.TerminationReading(1, above, False, False))
    with pytest.raises(ConversionError):
        conversions.abstract_state_to_msg(header, np.full((10, 10, 4), above))
