"""`ros2 bag play` with bags that cannot be played as a whole, and how it ends."""

import pytest
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagWriter
from mujoban_msgs_py.ros2 import bag_play
from mujoban_msgs_py.ros2.main import run
from mujoban_msgs_py.ros2.session import CommandError, import_type

TICKS = 10


@pytest.fixture
def bag(tmp_path):
    with BagWriter(tmp_path / "bag", [topics.POSE, topics.CLOCK]) as writer:
        for tick in range(1, 1 + TICKS):
            stamp = tick * topics.TICK
            pose = conversions.pose_to_msg(conversions.header(stamp), (tick, 0.0, 0.0))
            writer.write(topics.POSE.name, stamp, serialize_message(pose))
            writer.write(topics.CLOCK.name, stamp, serialize_message(conversions.clock_to_msg(stamp)))
    return str(tmp_path / "bag")


@pytest.fixture
def said(monkeypatch):
    """The names under which messages of the bag are published, in their order; nobody is waited for."""
    names, publish = [], Publisher.publish
    monkeypatch.setattr(bag_play.Player, "await_subscribers", lambda self: None)

    def note(self, message):
        names.extend([self.topic_name] * isinstance(message, bytes))
        publish(self, message)

    monkeypatch.setattr(Publisher, "publish", note)
    return names


def test_a_topic_of_an_unknown_type_is_left_out_with_a_warning_and_the_rest_is_played(bag, said, monkeypatch, capfd):
    def knows_no_clock(name, kind):
        if name == topics.CLOCK.type_name:
            raise CommandError(f"the type '{name}' is unknown: no installed package has it")
        return import_type(name, kind)

    monkeypatch.setattr(bag_play, "import_type", knows_no_clock)
    assert run(["bag", "play", bag, "-r", "100"]) == 0
    assert said == ["/pose"] * TICKS
    assert "Topic '/clock' is not played: the type 'rosgraph_msgs/msg/Clock' is unknown" in capfd.readouterr().err


def test_a_loop_without_a_message_ends_with_an_error(bag, said, capfd):
    assert run(["bag", "play", bag, "--loop", "--start-offset", "60"]) == 1
    assert not said and "nothing to play in a loop" in capfd.readouterr().err


@pytest.mark.parametrize(("given", "waits"), [("-1", []), ("0", [-1.0]), ("20", [0.02])])
def test_a_negative_time_to_wait_for_subscribers_is_none(bag, said, monkeypatch, given, waits):
    waited = []
    monkeypatch.setattr(Publisher, "wait_for_all_acked", lambda self, limit: waited.append(limit.nanoseconds / 1e9))
    assert run(["bag", "play", bag, "-r", "100", "--topics", "/pose", "--wait-for-all-acked", given]) == 0
    assert waited == waits
