"""Whose a message is: the identifier of a run, which the stamps of all its messages carry.

Simulated time goes in steps of `TICK` and begins at the identifier, a number of nanoseconds below one tick. So every
message of a run has it, whatever its type, and so has every answer, which repeats the stamp of its tick. Two runs that
get into one ROS domain, as from two machines, leave each other alone.
"""

from __future__ import annotations

import secrets
from typing import Final

from mujoban_msgs_py.topics import TICK

ANY: Final = -1
"""The run of a node that takes messages of all: one that is started by hand, beside whatever plays."""


def draw_run() -> int:
    """Return an identifier that no other run has, but by a chance of one in `TICK`."""
    return secrets.randbelow(TICK)


def run_of(stamp: int) -> int:
    """Return the run that a stamp [ns] belongs to."""
    return stamp % TICK
