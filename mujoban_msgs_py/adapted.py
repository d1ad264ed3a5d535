"""What is said on a topic, as a value: nodes of one process hand it over, and a message is made only where one is sent.

So does the type adaptation of ROS 2 (REP 2007). Nothing here needs rclpy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from mujoban_msgs_py.topics import Message


class Adapted:
    """A value that is said on a topic, and the message that it becomes where one is sent.

    Attributes:
        stamp: Of the tick [ns].
        value: What the topic's reader (`decoders.DECODERS`) makes of the message, to the bit.
    """

    def __init__(self, stamp: int, value: Any, make: Callable[[Any], Message]) -> None:
        """Take a value that nobody changes any more, and the function that makes its message."""
        self.stamp, self.value = stamp, value
        self._make = make

    @cached_property
    def message(self) -> Message:
        """The message; a ConversionError says that the value is not what its topic carries."""
        return self._make(self.value)


def message_of(said: Message | Adapted) -> Message:
    """Return the message that was said."""
    return said.message if isinstance(said, Adapted) else said
