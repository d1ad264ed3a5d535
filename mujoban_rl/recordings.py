"""Recorded episodes as endless ticks, for those who learn from them row by row.

Shapes: L ticks of an episode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_rl.engine import State

RecordingT = TypeVar("RecordingT")
Fields = dict[str, NDArray[Any]]
"""Values of ticks by name, [L, ...] each."""


class EndlessEpisodes(Generic[RecordingT]):
    """The endless ticks of one robot: recording after recording, in an order that is drawn anew each time."""

    def __init__(
        self,
        recordings: Sequence[RecordingT],
        read: Callable[[RecordingT, int], Fields | None],
        rng: np.random.Generator,
    ) -> None:
        """Begin with a random recording.

        Args:
            recordings: Bags, or whatever `read` reads.
            read: Returns the fields of a recording's episode by its number, [L, ...] each with `first`; None behind the
                last.
            rng: Draws the order.
        """
        self._recordings, self._read, self._rng = recordings, read, rng
        self._order: list[int] = []
        self._recording = self._episode = self._tick = 0
        self._fields: Fields | None = None

    def next(self) -> tuple[Fields, int]:
        """Return the fields of an episode, [L, ...], and the number of the tick whose turn it is."""
        fields = self._fields
        if fields is None or self._tick == len(fields["first"]):
            fields = self._following(begin=fields is None)
            self._fields, self._tick = fields, 0
        self._tick += 1
        return fields, self._tick - 1

    def _following(self, *, begin: bool) -> Fields:
        """Return the fields of the episode that comes next."""
        if not begin:
            self._episode += 1
        empty = 0
        while True:
            if self._recording == len(self._order):
                self._order, self._recording = self._rng.permutation(len(self._recordings)).tolist(), 0
            if (fields := self._read(self._recordings[self._order[self._recording]], self._episode)) is not None:
                return fields
            empty = empty + 1 if self._episode == 0 else 0
            if empty == len(self._recordings):
                raise ValueError(f"no episode of 2 ticks in {len(self._recordings)} bags: expected one at least")
            self._recording, self._episode = self._recording + 1, 0

    def state(self) -> State:
        """Return where it is."""
        return State({"order": self._order, "recording": self._recording, "episode": self._episode, "tick": self._tick})

    def restore(self, state: State) -> None:
        """Go on where it was."""
        values = state.values
        self._order, self._recording = list(values["order"]), values["recording"]
        self._episode, self._tick = values["episode"], values["tick"]
        began = self._recording < len(self._order)
        self._fields = self._read(self._recordings[self._order[self._recording]], self._episode) if began else None
