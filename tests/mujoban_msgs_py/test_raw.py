import numpy as np
import pytest
from mujoban_msgs.msg import AbstractState
from rclpy.serialization import serialize_message

from mujoban_msgs_py import conversions
from mujoban_msgs_py.raw import Steady, read


def state(tick, box=None):
    layers = np.zeros((10, 10, 4), np.float32)
    if box is not None:
        layers[(*box, 3)] = 1.0
    return serialize_message(conversions.abstract_state_to_msg(conversions.header(tick * 50_000_000), layers))


def test_what_a_steady_topic_says_is_read_once_until_it_changes():
    calls = []

    def decode(message):
        calls.append(message)
        return conversions.abstract_state_from_msg(message)

    reader = Steady(AbstractState, decode)
    for tick in range(3):
        assert reader(state(tick, (1, 2)))[1, 2, 3] == 1.0
    assert len(calls) == 1
    assert reader(state(3, (1, 3)))[1, 3, 3] == 1.0
    assert len(calls) == 2


def test_a_steady_topic_refuses_what_is_no_message_and_reads_on():
    reader = Steady(AbstractState, conversions.abstract_state_from_msg)
    with pytest.raises(ValueError, match="no serialised mujoban_msgs/msg/AbstractState"):
        reader(state(0)[:20])
    reader(state(0, (1, 2)))
    with pytest.raises(ValueError, match="no serialised mujoban_msgs/msg/AbstractState"):
        reader(state(1)[:40])
    assert reader(state(2, (1, 2)))[1, 2, 3] == 1.0


@pytest.mark.parametrize("kind", [2, 7, 10])
def test_a_kind_of_cdr_that_no_bag_can_be_read_with_is_no_message(kind):
    message = state(0)
    assert read(message, AbstractState) is not None
    with pytest.raises(ValueError, match="no serialised mujoban_msgs/msg/AbstractState"):
        read(message[:1] + bytes([kind]) + message[2:], AbstractState)
