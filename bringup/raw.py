"""What can be read off a serialised message without deserialising it."""

from __future__ import annotations

import struct

_LITTLE_ENDIAN = 1
_ENCAPSULATION = 4
"""Bytes before the first field of a message in CDR."""


def raw_stamp(message: bytes) -> int:
    """Return the stamp [ns] of a serialised message whose first field is a header or a time.

    Raises:
        ValueError: If the message is too short to hold one.
    """
    if len(message) < _ENCAPSULATION + 8:
        raise ValueError(f"a serialised message of {len(message)} bytes holds no stamp")
    order = "<" if message[1] & _LITTLE_ENDIAN else ">"
    second, nanosecond = struct.unpack_from(order + "iI", message, _ENCAPSULATION)
    return second * 1_000_000_000 + nanosecond
