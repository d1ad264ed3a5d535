"""A message as it arrives at a node: serialised, through the middleware, or handed over by a node of the process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mujoban_msgs_py.adapted import Adapted, message_of
from mujoban_msgs_py.conversions import stamp_of
from mujoban_msgs_py.decoders import Decode
from mujoban_msgs_py.raw import raw_stamp, read
from mujoban_msgs_py.topics import Message


class Serialised:
    """A message that has come through the middleware."""

    def __init__(self, raw: bytes, kind: type[Message]) -> None:
        """Take the CDR of a message of a type."""
        self.raw = raw
        self._kind = kind

    @property
    def stamp(self) -> int:
        """Of the tick [ns]; a ValueError says that there is none."""
        return raw_stamp(self.raw)

    def content(self, decode: Decode | None) -> Any:
        """Return what a function makes of the message, or the message; shared with others, so leave it as it is.

        Raises:
            ValueError: If the bytes are not a message of its type, or not what the function takes.
        """
        return read(self.raw, self._kind, decode)


class Handed:
    """What a node of the same process has handed over."""

    raw = b""

    def __init__(self, said: Message | Adapted, reader: Decode) -> None:
        """Take what was said on a topic of a reader; all who receive it leave it as it is."""
        self._said = said
        if isinstance(said, Adapted):
            self.stamp = said.stamp
            self._contents: dict[Decode | None, Any] = {reader: said.value}
        else:
            self.stamp = stamp_of(said)
            self._contents = {}

    def content(self, decode: Decode | None) -> Any:
        """Return what a function makes of the message, as `Serialised` does."""
        if decode in self._contents:
            return self._contents[decode]
        message = message_of(self._said)
        if decode is None:
            return message
        content = self._contents[decode] = decode(message)
        return content


Arrival = Serialised | Handed
Receive = Callable[[Arrival], None]
"""Called with each message of a topic."""
