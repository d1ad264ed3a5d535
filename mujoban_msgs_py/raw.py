"""Serialised messages: what can be read off them without deserialising, and deserialising each only once.

Nodes that share a process receive the same bytes: the camera's image goes to three of them, `/episode` to all.
Deserialising costs more than anything else in rclpy, so it is done for the first and remembered for the others.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rclpy.serialization import deserialize_message

from mujoban_msgs_py.topics import Message, type_name

_LITTLE_ENDIAN = 1
_ENCAPSULATION = 4
"""Bytes before the first field of a message in CDR."""
_SECOND = 1_000_000_000
_REMEMBERED = 64
"""Messages of about four ticks."""


def raw_stamp(message: bytes) -> int:
    """Return the stamp [ns] of a serialised message whose first field is a header or a time.

    Raises:
        ValueError: If the message is too short to hold one, or what it holds is no simulated time.
    """
    if len(message) < _ENCAPSULATION + 8:
        raise ValueError(f"a serialised message of {len(message)} bytes holds no stamp")
    order = "<" if message[1] & _LITTLE_ENDIAN else ">"
    second, nanosecond = struct.unpack_from(order + "iI", message, _ENCAPSULATION)
    if second < 0 or nanosecond >= _SECOND:
        raise ValueError(f"a stamp of {second} s and {nanosecond} ns is no simulated time")
    return second * _SECOND + nanosecond


@lru_cache(maxsize=_REMEMBERED)
def read(message: bytes, kind: type[Message], decode: Callable[[Any], Any] | None = None) -> Any:
    """Return what a serialised message holds; the result is shared, so leave it as it is.

    Args:
        message: CDR, as raw subscriptions deliver it.
        kind: Type of the message.
        decode: Applied to the message, if given; what it raises passes through.

    Raises:
        ValueError: If the bytes are not a message of this type.
    """
    try:
        if message[1:2] > bytes([_LITTLE_ENDIAN]):  # other kinds of CDR, which rclpy reads and readers of bags do not
            raise RuntimeError
        content = deserialize_message(message, kind)
    except RuntimeError:
        raise ValueError(f"its {len(message)} bytes are no serialised {type_name(kind)}") from None
    return content if decode is None else decode(content)


def _after_header(message: bytes) -> int:
    """Return where the fields after a header begin; the bytes that pad the frame's name are of no value."""
    order = "little" if message[1] & _LITTLE_ENDIAN else "big"
    length = int.from_bytes(message[_ENCAPSULATION + 8 : _ENCAPSULATION + 12], order)
    return (_ENCAPSULATION + 12 + length + 3) // 4 * 4


class Steady:
    """Reads a topic that says the same for many ticks: where only the header is new, nothing is deserialised."""

    def __init__(self, kind: type[Message], decode: Callable[[Any], Any]) -> None:
        """Read messages whose first field is a header, by a function that leaves the header out."""
        self._kind, self._decode = kind, decode
        self._said: bytes | None = None
        self._content: Any = None

    def __call__(self, message: bytes) -> Any:
        """Return what a message holds beside its stamp, as `read` does.

        Raises:
            ValueError: If the bytes are not a message of this type, or not what the function takes.
        """
        said = message[_after_header(message) :]
        if said != self._said:
            self._content = read(message, self._kind, self._decode)
            self._said = said
        return self._content
