"""Make a bag whose recorder was killed whole again, so that every tool can read it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.reader import open_bag
from mujoban_msgs_py.bags.writer import BagWriter

REPLACED: Final = ".damaged"
"""End of the name that a bag gets whose place a recovered one takes; trainers pass it over among others."""
PARTIAL: Final = ".reindexed"
"""End of the name of a recovered bag until then; they pass it over as well."""


def recover_bag(source: str | Path, target: str | Path) -> list[str]:
    """Copy all that is whole of a bag to a new one.

    Returns:
        What was left out because it was damaged, in words.

    Raises:
        BagError: If there is no bag at `source`, or something at `target`.
    """
    bag = open_bag(source, damaged="skip")
    if not bag.topics:
        raise BagError(f"nothing can be recovered from {source}: it has no whole chunk")
    with BagWriter(target, about=bag.about) as writer:
        for info in bag.topics.values():
            writer.add_topic(info.name, info.type_name, info.qos)
        for message in bag.messages():
            writer.write(message.topic, message.stamp, message.data)
    return bag.skipped
