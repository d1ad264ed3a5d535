"""A message as it arrives at a node: serialised, through the middleware, or handed over by a node of the process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
    """A message that a node of the same process has handed over."""

    raw = b""

    def __init__(self, message: Message) -> None:
        """Take a message, which all who receive it leave as it is."""
        self._message = message
        self._contents: dict[Decode | None, Any] = {None: message}
        self.stamp = stamp_of(message)

    def content(self, decode: Decode | None) -> Any:
        """Return what a function makes of the message, as `Serialised` does."""
        if decode not in self._contents:
            assert decode is not None
            self._contents[decode] = decode(self._message)
        return self._contents[decode]


Arrival = Serialised | Handed
Receive = Callable[[Arrival], None]
"""Called with each message of a topic."""
