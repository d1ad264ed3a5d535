"""Simulated time that jumps back: another simulator, one that another was ahead of, or a bag played from its start."""

from __future__ import annotations

from typing import Final

REPEATS: Final = 3
"""Offers of one tick below the newest, with no newer one between them, that say that time has jumped back: a simulator
repeats a tick only while it waits for an answer."""


class Jumps:
    """Tells by the ticks that are offered on `/episode` whether time has jumped back."""

    def __init__(self) -> None:
        """Know of no offer yet."""
        self._stamp, self._times = -1, 0

    def note(self, stamp: int, step: int, newest: int) -> bool:
        """Note an offer and tell whether time has jumped back with it.

        Args:
            stamp: Of the tick [ns].
            step: Number of the tick within its episode; one that begins is not waited for.
            newest: Stamp of the newest tick that is done with [ns].
        """
        if stamp >= newest:
            self._stamp, self._times = -1, 0
            return False
        self._stamp, self._times = stamp, self._times + 1 if stamp == self._stamp else 1
        return step == 0 or self._times >= REPEATS
