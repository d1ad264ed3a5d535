"""Recorded episodes as endless ticks, for those who learn from them row by row.

Shapes: L ticks of an episode, R rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_rl.engine import State

RecordingT = TypeVar("RecordingT")
Fields = dict[str, NDArray[Any]]
"""Values of ticks by name, [L, ...] each."""


class EndlessEpisodes(Generic[RecordingT]):
    """The endless ticks of R robots: recording after recording, in an order that is drawn anew each time."""

    def __init__(
        self,
        recordings: Sequence[RecordingT],
        read: Callable[[RecordingT], Iterator[Fields]],
        rng: np.random.Generator,
        rows: int,
        name: Callable[[RecordingT], str] = str,
    ) -> None:
        """Begin every row with a random recording.

        Args:
            recordings: Bags, or whatever `read` reads.
            read: Yields the fields of a recording's episodes, [L, ...] each with `first`.
            rng: Draws the order.
            rows: R.
            name: What a recording is known by when a run goes on.
        """
        self._rng = rng
        self._names = [name(recording) for recording in recordings]
        self._rows = [_Row(recordings, read, rng) for _ in range(rows)]

    def __len__(self) -> int:
        """Return R."""
        return len(self._rows)

    def next(self) -> list[tuple[Fields, int]]:
        """Return of every row the fields of an episode, [L, ...], and the number of the tick whose turn it is.

        Raises:
            ValueError: If there is no episode in all recordings.
        """
        return [row.next() for row in self._rows]

    def state(self) -> State:
        """Return where the rows are."""
        own = State({"rng": self._rng.bit_generator.state, "recordings": self._names})
        return State.of({"own": own} | {f"row{i}": row.state() for i, row in enumerate(self._rows)})

    def restore(self, state: State) -> None:
        """Go on where they were; with other recordings than then, begin anew."""
        own = state.part("own").values
        if own.get("recordings", self._names) != self._names:
            return
        self._rng.bit_generator.state = own["rng"]
        for i, row in enumerate(self._rows):
            row.restore(state.part(f"row{i}"))


class _Row(Generic[RecordingT]):
    """The endless ticks of one robot; a recording is read once each time that its turn comes."""

    def __init__(
        self,
        recordings: Sequence[RecordingT],
        read: Callable[[RecordingT], Iterator[Fields]],
        rng: np.random.Generator,
    ) -> None:
        self._recordings, self._read, self._rng = recordings, read, rng
        self._order: list[int] = []
        self._begun = self._episode = self._tick = 0
        """Recordings of the order that were begun, episodes of the newest one, and ticks of its newest episode."""
        self._open: Iterator[Fields] = iter(())
        self._fields: Fields | None = None

    def next(self) -> tuple[Fields, int]:
        fields = self._fields
        if fields is None or self._tick == len(fields["first"]):
            self._fields = fields = self._following()
            self._tick = 0
        self._tick += 1
        return fields, self._tick - 1

    def _following(self) -> Fields:
        """Return the fields of the episode that comes next."""
        empty = 0
        while (fields := next(self._open, None)) is None:
            empty += self._episode == 0
            if empty > len(self._recordings):
                raise ValueError(f"no episode of 2 ticks in {len(self._recordings)} bags: expected one at least")
            if self._begun == len(self._order):
                self._order, self._begun = self._rng.permutation(len(self._recordings)).tolist(), 0
            self._begun, self._episode = self._begun + 1, 0
            self._open = self._read(self._recordings[self._order[self._begun - 1]])
        self._episode += 1
        return fields

    def state(self) -> State:
        return State({"order": self._order, "begun": self._begun, "episode": self._episode, "tick": self._tick})

    def restore(self, state: State) -> None:
        values = state.values
        self._order, self._begun = list(values["order"]), values["begun"]
        self._episode, self._tick = values["episode"], values["tick"]
        self._open, self._fields = iter(()), None
        if self._begun:
            recording = self._recordings[self._order[self._begun - 1]]
            self._open = islice(self._read(recording), max(self._episode - 1, 0), None)
            self._fields = next(self._open, None) if self._episode else None
