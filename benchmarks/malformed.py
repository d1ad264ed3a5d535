"""Messages that a topic of the graph should never carry, made from those that it carries."""

from __future__ import annotations

from array import array
from contextlib import suppress
from functools import partial
from typing import Any, Final

import numpy as np
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.run_identifier import run_of
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_msgs_py.topics import EPISODE, GRAPH_TOPICS, MONITORED, RECORDED, TICK, Topic

TARGETS: Final = (*GRAPH_TOPICS.values(), RECORDED, MONITORED)
"""Topics that are attacked."""
KINDS: Final = ("garbage", "truncated", "flipped", "extended", "field", "field", "stamp", "replayed")
"""What is done to a message, in turns."""
_NUMBERS: Final = (0.0, -0.0, 1.5, -1.0, 1e30, -1e30, float("nan"), float("inf"), -float("inf"))
_INTEGERS: Final = (0, 1, 2, 5, 127, 255, 65535, 2**31 - 1, 2**32 - 1, 2**63 - 1, -1, -(2**31))
_STEPS: Final = 100
"""Ticks that may be missed between two that are heard."""
DEPTH: Final = 16
"""Messages of a topic that wait to be heard, those of its own among them."""
_STAMPS: Final = (0, TICK // 2, TICK, -TICK, 10**15, 2**31 * 10**9 - 1)
"""Nanoseconds to move a stamp by."""


def malform(kind: str, topic: Topic, message: bytes, rng: np.random.Generator) -> bytes:
    """Return a serialised message that was damaged in one of `KINDS`; now and then it is sound all the same."""
    if kind == "garbage":
        return rng.bytes(int(rng.integers(0, 2 * len(message))))
    if kind == "truncated":
        return message[: int(rng.integers(0, len(message)))]
    if kind == "flipped":
        data = bytearray(message)
        for _ in range(int(rng.integers(1, 9))):
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        return bytes(data)
    if kind == "extended":
        return message + rng.bytes(int(rng.integers(1, 4096)))
    if kind == "replayed":
        return message
    content = deserialize_message(message, topic.type)
    if kind == "stamp":
        _move_stamp(content, rng)
    else:
        spoil(content, rng)
    return serialize_message(content)


def _move_stamp(content: Any, rng: np.random.Generator) -> None:
    stamped = getattr(content, "header", content)
    time = stamped.stamp if hasattr(stamped, "stamp") else stamped.clock
    moved = time.sec * 10**9 + time.nanosec + int(rng.choice(_STAMPS))
    time.sec, time.nanosec = int(np.clip(moved // 10**9, -(2**31), 2**31 - 1)), int(moved % 10**9)


def spoil(content: Any, rng: np.random.Generator) -> None:
    """Give a field of a message, at any depth, a value that its type allows and its topic does not."""
    fields = list(content.get_fields_and_field_types().items())
    name, kind = fields[rng.integers(len(fields))]
    value = getattr(content, name)
    if hasattr(value, "get_fields_and_field_types"):
        spoil(value, rng)
    elif isinstance(value, array | list) and "sequence" in kind:
        setattr(content, name, _spoiled_sequence(value, rng))
    elif isinstance(value, np.ndarray):
        value[rng.integers(len(value))] = rng.choice(_NUMBERS)
    elif isinstance(value, bool):
        setattr(content, name, not value)
    elif isinstance(value, str):
        setattr(content, name, ("", "\x00", "x" * 10_000, "#" * 99 + "\n")[rng.integers(4)])
    elif isinstance(value, float):
        setattr(content, name, _NUMBERS[rng.integers(len(_NUMBERS))])
    elif isinstance(value, int):
        setattr(content, name, _integer(kind, rng))


def _integer(kind: str, rng: np.random.Generator) -> int:
    bits = int("".join(c for c in kind if c.isdigit()) or 8)
    low, high = (0, 2**bits - 1) if kind.startswith("uint") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return int(min(max(_INTEGERS[rng.integers(len(_INTEGERS))], low), high))


def _spoiled_sequence(value: Any, rng: np.random.Generator) -> Any:
    """Return a sequence that is too short, too long, empty, or holds a number that is none."""
    choice = rng.integers(4)
    if choice == 0 or not len(value):
        return value[:0]
    if choice == 1:
        return value[: int(rng.integers(len(value)))]
    if choice == 2:
        return value + value[:1]
    spoiled = value[:]
    if isinstance(spoiled, array) and spoiled.typecode in "fd":
        spoiled[int(rng.integers(len(spoiled)))] = _NUMBERS[rng.integers(len(_NUMBERS))]
    elif isinstance(spoiled, list) and hasattr(spoiled[0], "get_fields_and_field_types"):
        spoil(spoiled[int(rng.integers(len(spoiled)))], rng)
    return spoiled


class Vandal(Node):
    """A node that belongs to nobody: it hears every topic of the graph and says it again, spoiled.

    Attributes:
        sent: Messages published so far, by topic.
        heard: Ticks of the graph heard so far.
    """

    def __init__(self, rng: np.random.Generator, **options: Any) -> None:
        """Start listening; `act` attacks."""
        super().__init__("vandal", **options)
        self._rng = rng
        self._last: dict[str, bytes] = {topic.name: serialize_message(topic.type()) for topic in TARGETS}
        self._mouths = {topic.name: self.create_publisher(topic.type, topic.name, topic.qos) for topic in TARGETS}
        self.sent = dict.fromkeys(self._last, 0)
        self.heard = self._tick = 0
        for topic in TARGETS:
            listen(self, topic, partial(self._hear, topic), qos=live_qos(DEPTH))

    def act(self, count: int = 1) -> None:
        """Publish so many spoiled messages on every topic."""
        for topic in TARGETS:
            for _ in range(count):
                kind = KINDS[self.sent[topic.name] % len(KINDS)]
                # The middleware itself refuses more bytes than a type of fixed size has.
                with suppress(RuntimeError):
                    self._mouths[topic.name].publish(malform(kind, topic, self._last[topic.name], self._rng))
                self.sent[topic.name] += 1

    def _hear(self, topic: Topic, message: Received) -> None:
        self._last[topic.name] = message.raw
        # It hears itself as well: the run goes on where /episode has a later tick, and one that can follow.
        follows = not self._tick or self._tick < message.stamp <= self._tick + _STEPS * TICK
        if topic is EPISODE and follows and (not self._tick or run_of(message.stamp) == run_of(self._tick)):
            self._tick = message.stamp
            self.heard += 1
