"""How long a node waits for what belongs to a tick besides its inputs."""

import pytest
from geometry_msgs.msg import PoseStamped
from mujoban_msgs.msg import Episode
from rclpy.serialization import serialize_message

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.arrivals import Serialised
from mujoban_msgs_py.runtime.tick_node import PATIENCE, Output, TickNode, run_node


class Waiting(TickNode):
    """Answers a tick only where it is told that waiting will not help."""

    def __init__(self):
        super().__init__("waiting")
        self.answered = []
        self.open_inputs([topics.POSE])

    def answer(self, stamp, episode, inputs, *, insist):
        if not insist:
            return None
        self.answered.append(stamp // topics.TICK)
        return ()

    def offer(self, tick):
        header = conversions.header(tick * topics.TICK)
        pose = PoseStamped(header=header)
        for topic, message in ((topics.EPISODE, Episode(header=header, episode=1, step=tick)), (topics.POSE, pose)):
            self._receive(topic, None, Serialised(serialize_message(message), topic.type))


class Deep(Waiting):
    """Has a depth.

    Parameters:
        depth: How deep it is.
    """


class Wider(Deep):
    """Has a width, too.

    Parameters, beside those of `Deep`:
        width: How wide it is.
    """


class Prompt(Waiting):
    """Answers every tick at once, with something."""

    def __init__(self):
        super().__init__()
        self.output = self.create_output(topics.TRUE_POSE)

    def answer(self, stamp, episode, inputs, *, insist):
        super().answer(stamp, episode, inputs, insist=True)
        return [Output(self.output, inputs[topics.POSE.name])]


@pytest.fixture
def prompt(ros):
    node = Prompt()
    yield node
    node.destroy_node()


@pytest.fixture
def waiting(ros):
    node = Waiting()
    yield node
    node.destroy_node()


def test_a_tick_that_is_offered_again_is_waited_for_as_long_as_before(waiting):
    for _ in range(1 + PATIENCE):
        waiting.offer(5)
    assert waiting.answered == []
    waiting.offer(5)
    assert waiting.answered == [5]


def test_a_node_refuses_arguments_that_are_not_ros_and_tells_of_itself_when_asked(capsys):
    assert run_node(Waiting, ["--weights", "mine"]) == 2
    assert "error: --weights is no option of a node, expected --ros-args -p NAME:=VALUE" in capsys.readouterr().err
    assert run_node(Waiting, ["--ros-args", "-p", "a:=1", "--", "--help"]) == 0
    assert "--ros-args -p NAME:=VALUE" in capsys.readouterr().out


def test_a_node_tells_of_the_parameters_that_it_has_by_its_base_once(capsys):
    for node in (Wider, type("Wider", (Wider,), {})):
        assert run_node(node, ["--help"]) == 0
        said = capsys.readouterr().out
        assert said.startswith("Has a width, too.") and said.count("width: ") == said.count("depth: ") == 1


def test_where_time_goes_on_the_next_tick_does_not_wait_as_well(waiting):
    waiting.offer(5)
    waiting.offer(6)
    assert waiting.answered == [6]


def test_a_simulator_that_another_was_ahead_of_is_answered_once_it_alone_asks(prompt):
    for tick in (49, 150):
        prompt.offer(tick)
    for tick in (50, 50, 150, 50, 50, 150):  # the other is there still
        prompt.offer(tick)
    assert prompt.answered == [49, 150]
    for tick in (50, 50, 50, 51):
        prompt.offer(tick)
    assert prompt.answered == [49, 150, 50, 51]
