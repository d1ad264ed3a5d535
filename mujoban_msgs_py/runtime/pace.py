"""The clock of real time: whether it runs, how fast simulated time goes, and how many answers come late."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from mujoban_core.grid import CONTROL_PERIOD
from mujoban_msgs_py.topics import TICK

WINDOW: Final = 10.0
"""Seconds that are looked at together; at most one warning comes of each."""
KEPT: Final = 0.95
"""Share of the wanted speed from which on real time counts as kept."""
LATE: Final = 0.05
"""Share of late answers up to which it does."""
REMEMBERED: Final = 10_000
"""Answers whose times are kept."""


@dataclass
class Pace:
    """Simulated against wall time, window by window."""

    speed: float
    """Simulated seconds per second that are wanted; 0 is lockstep, which keeps to no clock."""
    patience: float
    """Seconds without an answer after which the clock is stopped."""
    hold: int
    """Ticks for which a torque is held until the clock waits: a robot must not drive on without a driver."""
    running: bool = False
    """Whether the clock runs; it starts with the first tick that was answered."""
    heard: float = 0.0
    """When the last answer came, to this tick or to one before."""
    newest: int = 0
    """Stamp of the newest tick that was answered [ns]."""
    ticks: int = 0
    """In the window so far."""
    late: int = 0
    """Ticks of the window without a torque of their own."""
    answer_times: deque[float] = field(default_factory=lambda: deque[float](maxlen=REMEMBERED))
    """Seconds from the offer of a tick to its torque, of the latest ticks that got one."""
    _offered: dict[int, float] = field(default_factory=dict[int, float])
    _since: float = 0.0
    _kept: bool = True

    def falls_silent(self, now: float, *, answered: bool) -> bool:
        """Start the clock when a tick has been answered; stop it, and return True, when no answers come any more.

        Args:
            now: Seconds of a clock that never jumps.
            answered: Whether everybody has answered the tick that is open.
        """
        if answered:
            if not self.running:
                self.start(now)
            self.running, self.heard = True, now
        elif self.running and now - self.heard > self.patience:
            self.running = self._kept = False
            return True
        return False

    def offer(self, stamp: int, now: float) -> None:
        """Note that the modules are given the tick of a stamp."""
        self._offered[stamp] = now

    def hear(self, stamp: int, now: float) -> None:
        """Note an answer to the tick of a stamp."""
        self.newest, self.heard = max(self.newest, stamp), now
        if (offered := self._offered.get(stamp)) is not None:
            self.answer_times.append(now - offered)
        self._offered = {other: at for other, at in self._offered.items() if other > stamp}

    def outruns(self, stamp: int) -> bool:
        """Tell whether the clock is too far ahead of the answers to go on from the tick of a stamp."""
        return stamp - self.newest > self.hold * TICK

    def answer_ms(self, percentile: float) -> float:
        """Return how long answers take, in milliseconds: a percentile of the latest ticks, 0 before any."""
        return 1e3 * float(np.percentile(self.answer_times or [0.0], percentile))

    def start(self, now: float) -> None:
        """Begin a window, as after a pause; `now` in seconds of a clock that never jumps."""
        self.ticks, self.late, self._since = 0, 0, now

    def tick(self, *, late: bool) -> None:
        """Count a tick."""
        self.ticks += 1
        self.late += late

    @property
    def kept(self) -> bool:
        """Whether real time was kept in the last window, and the clock has not stopped since."""
        return self._kept

    def complaint(self, now: float) -> str | None:
        """At the end of a window, begin the next and return what is wrong in one line, if anything is."""
        seconds = now - self._since
        if self.speed == 0 or seconds < WINDOW:
            return None
        wanted = self.speed / CONTROL_PERIOD
        rate, share = self.ticks / seconds, self.late / max(1, self.ticks)
        self.start(now)
        self._kept = rate >= KEPT * wanted and share <= LATE
        if self._kept:
            return None
        return (
            f"real time is not kept: {rate:.1f} of {wanted:.1f} ticks/s, {100 * share:.0f} % of the answers late "
            f"in the last {seconds:.0f} s; the machine is too busy or too slow for this speed"
        )
