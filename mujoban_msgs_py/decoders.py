"""What each topic of the graph carries: how its messages become the values of `conversions`.

`checked` is for those who want the message itself, and it to be what its topic carries.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.topics import Message, Topic

Decode = Callable[[Any], Any]
"""Turns a message into a value, or raises `ConversionError`."""


def _any_size(message: Image) -> NDArray[np.uint8]:
    return conversions.frame_from_msg(message, None)


DECODERS: Final[dict[Topic, Decode]] = {
    topics.CLOCK: conversions.stamp_of,
    topics.EPISODE: conversions.episode_from_msg,
    topics.CAMERA: conversions.frame_from_msg,
    topics.CAMERA_INFO: conversions.camera_info_from_msg,
    topics.PROPRIO: conversions.body_proprio_from_msg,
    topics.POSE: conversions.pose_from_msg,
    topics.ABSTRACT_STATE: conversions.abstract_state_from_msg,
    topics.TERMINATION: conversions.termination_from_msg,
    topics.INSTRUCTION: conversions.instruction_from_msg,
    topics.TORQUE: conversions.torque_from_msg,
    topics.TRUE_ABSTRACT_STATE: conversions.abstract_state_from_msg,
    topics.TRUE_POSE: conversions.pose_from_msg,
    topics.TRUE_TWIST: conversions.twist_from_msg,
    topics.TRUE_BOXES: conversions.boxes_from_msg,
    topics.TRUE_TERMINATION: conversions.termination_from_msg,
    topics.TRUE_EPISODE: conversions.episode_truth_from_msg,
    topics.TOP_CAMERA: _any_size,
    topics.RECORDED: conversions.stamp_of,
    topics.MONITORED: conversions.stamp_of,
}
"""The reader of every topic."""


@cache
def checked(topic: Topic) -> Decode:
    """Return a function that returns a message as it is, after a look at whether its topic's reader takes it."""
    decode = DECODERS[topic]

    def check(message: Message) -> Message:
        decode(message)
        return message

    return check
