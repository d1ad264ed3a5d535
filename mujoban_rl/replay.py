"""The one replay: a ring of sequences of ticks, from which windows of any length are drawn evenly.

Recurrent learners keep the memory before each tick as a field, and take that of a window's first tick (Kapturowski et
al. 2019); n-step returns are read off a window of n + 1 ticks.

Shapes: C sequences in the ring, L ticks of a sequence, B environments, M windows of a batch, W ticks of a window.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_rl.engine import State

Ticks = Mapping[str, NDArray[Any] | Tensor]
"""Fields by name; tensors are on the CPU."""


def steps_per_update(windows: int, ticks: int, reuse: float) -> float:
    """Return how many new steps there are for each update, so that one is learned from `reuse` times on average.

    Args:
        windows: M.
        ticks: Of a window, those in which something is learned.
        reuse: How often.
    """
    return windows * ticks / reuse


class SequenceReplay:
    """The last C sequences of L ticks each. Fields are laid out by the first sequences that are added."""

    def __init__(self, capacity: int, length: int) -> None:
        """Hold up to `capacity` sequences of `length` ticks.

        Raises:
            ValueError: If either is not positive.
        """
        if capacity < 1 or length < 1:
            raise ValueError(f"capacity {capacity} and length {length}: expected positive numbers")
        self.capacity, self.length = capacity, length
        self.added = 0
        """Sequences added so far."""
        self._fields: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        """Return the number of sequences held now."""
        return min(self.added, self.capacity)

    def add(self, sequences: Ticks) -> None:
        """Add one sequence of each of B environments, fields [L, B, ...]; the oldest make room.

        Raises:
            ValueError: If a field has another number of ticks, or the fields are not those of before.
        """
        columns = {name: _array(values).swapaxes(0, 1) for name, values in sequences.items()}
        for name, values in columns.items():
            if values.shape[1] != self.length:
                raise ValueError(f"field {name} has {values.shape[1]} ticks: expected {self.length}")
        if not self._fields:
            self._fields = {k: np.zeros((self.capacity, *v.shape[1:]), v.dtype) for k, v in columns.items()}
        if columns.keys() != self._fields.keys():
            raise ValueError(f"fields {sorted(columns)}: expected {sorted(self._fields)}")
        count = len(next(iter(columns.values())))
        # Of more than fit, the last stay.
        slots = (self.added + np.arange(count))[-self.capacity :] % self.capacity
        for name, values in columns.items():
            self._fields[name][slots] = values[-self.capacity :]
        self.added += count

    def sample(self, count: int, generator: torch.Generator, window: int | None = None) -> dict[str, Tensor]:
        """Return M = `count` windows from uniform sequences and starts, with replacement; fields [M, W, ...].

        Args:
            count: M.
            generator: CPU source of the draw.
            window: W; whole sequences by default.

        Raises:
            ValueError: If the replay is empty or a sequence holds no such window.
        """
        window = self.length if window is None else window
        if not 1 <= window <= self.length:
            raise ValueError(f"window of {window} ticks: expected 1 to {self.length}, the ticks of a sequence")
        if not self.added:
            raise ValueError("the replay is empty: add sequences before sampling")
        rows = torch.randint(len(self), (count,), generator=generator).numpy()
        starts = torch.randint(self.length - window + 1, (count,), generator=generator).numpy()
        ticks = starts[:, None] + np.arange(window)
        return {name: torch.from_numpy(values[rows[:, None], ticks]) for name, values in self._fields.items()}

    def state(self) -> State:
        """Return all that is held."""
        held = {name: torch.from_numpy(values[: len(self)]) for name, values in self._fields.items()}
        return State({"added": self.added}, held)

    def restore(self, state: State) -> None:
        """Take over what `state` of a replay of any capacity returned: of more than fit, the newest.

        Raises:
            ValueError: If its sequences have another length.
        """
        self._fields = {}
        count = len(next(iter(state.tensors.values()), ()))
        added = state.values["added"]
        # Of the same capacity all comes to where it was; a larger one has held no more than this.
        self.added = added - count if count >= self.capacity else 0
        if count:
            oldest_first = (added + np.arange(count)) % count
            self.add({name: held.numpy()[oldest_first].swapaxes(0, 1) for name, held in state.tensors.items()})


class SequenceBuilder:
    """Joins ticks to sequences, each of which begins with the last ticks of the one before.

    With an overlap of W - 1 ticks, windows of W ticks begin at every tick equally often.
    """

    def __init__(self, length: int, overlap: int = 0) -> None:
        """Join `length` ticks, of which `overlap` were in the sequence before.

        Raises:
            ValueError: If a sequence holds nothing new.
        """
        if not 0 <= overlap < length:
            raise ValueError(f"overlap of {overlap} ticks: expected 0 to {length - 1}, fewer than a sequence holds")
        self.length, self.overlap = length, overlap
        self._ticks: list[dict[str, NDArray[Any]]] = []

    def add(self, tick: Ticks) -> dict[str, NDArray[Any]] | None:
        """Add a tick, fields [B, ...]; return a sequence [L, B, ...] once there is a new one."""
        self._ticks.append({name: _array(values).copy() for name, values in tick.items()})
        if len(self._ticks) < self.length:
            return None
        sequence = _stack(self._ticks)
        self._ticks = self._ticks[self.length - self.overlap :]
        return sequence

    def state(self) -> State:
        """Return the ticks that wait."""
        return State(tensors={k: torch.from_numpy(v) for k, v in _stack(self._ticks).items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        columns = {name: values.numpy() for name, values in state.tensors.items()}
        count = len(next(iter(columns.values()), ()))
        self._ticks = [{name: values[i] for name, values in columns.items()} for i in range(count)]


class TickReplay:
    """A replay that takes ticks one by one and gives windows of one length, which begin at every tick equally often."""

    def __init__(self, capacity: int, length: int, window: int) -> None:
        """Hold up to `capacity` sequences of `length` ticks, and draw windows of `window`.

        Raises:
            ValueError: If a number is not positive.
        """
        self.window = window
        self._replay = SequenceReplay(capacity, length)
        # Whole sequences have one start each, wherever they begin.
        self._builder = SequenceBuilder(length, window - 1 if window < length else 0)

    @property
    def added(self) -> int:
        """Sequences added so far."""
        return self._replay.added

    def add(self, tick: Ticks) -> None:
        """Add a tick, fields [B, ...]; it is drawn from once its sequence is whole."""
        if (sequence := self._builder.add(tick)) is not None:
            self._replay.add(sequence)

    def sample(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Return M = `count` windows, fields [M, W, ...]; see `SequenceReplay.sample`."""
        return self._replay.sample(count, generator, self.window)

    def state(self) -> State:
        """Return all that is held."""
        return State.of({"replay": self._replay.state(), "builder": self._builder.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._replay.restore(state.part("replay"))
        self._builder.restore(state.part("builder"))


def _array(values: NDArray[Any] | Tensor) -> NDArray[Any]:
    return values.numpy() if isinstance(values, Tensor) else values


def _stack(ticks: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    return {name: np.stack([tick[name] for tick in ticks]) for name in (ticks[0] if ticks else {})}
