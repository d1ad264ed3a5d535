"""Batches from recorded bags, read in a process beside the training or between its steps."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, IterableDataset

from mujoban_core import children
from mujoban_core.bodies import get_body
from mujoban_estimator.bag_stream import BagStream, KeptBags
from mujoban_estimator.data import Batch, Batcher
from mujoban_rl.engine import Source, State

_AHEAD: Final = 2
"""Batches that are read ahead."""


@dataclass(frozen=True)
class Reading:
    """What is read, and how."""

    bags: Sequence[Path]
    body: str
    streams: int
    """Bags that are read side by side; each is a row of the batch."""
    length: int
    """Ticks of a stretch."""
    seed: int
    skip_damaged: bool = False
    """Leave damaged parts of bags out instead of refusing them."""
    allow_test_seeds: bool = False
    """Learn also from episodes whose levels are not for training."""


class _Place(NamedTuple):
    """Where reading stands after a batch."""

    streams: list[dict[str, Any]]
    seen: NDArray[np.bool_]


class _Item(NamedTuple):
    """What the reading process hands over."""

    batch: Batch
    after: _Place
    cpu_seconds: float


class _Batches(IterableDataset[_Item]):
    """Endless batches from a place on."""

    def __init__(self, reading: Reading, place: _Place | None) -> None:
        super().__init__()
        self._reading, self._place = reading, place

    def __iter__(self) -> Iterator[_Item]:
        r = self._reading
        kept = KeptBags()
        streams = [
            BagStream(r.bags, r.length, rng, kept, skip_damaged=r.skip_damaged, allow_test_seeds=r.allow_test_seeds)
            for rng in np.random.default_rng([r.seed, 0]).spawn(r.streams)
        ]
        batcher = Batcher(streams, r.length, get_body(r.body))
        if self._place is not None:
            batcher.seen = self._place.seen.copy()
            for stream, state in zip(streams, self._place.streams, strict=True):
                stream.restore(state)
        for batch in batcher:
            place = _Place([stream.state() for stream in streams], batcher.seen.copy())
            yield _Item(batch, place, time.process_time())


class BagSource(Source[Batch]):
    """Endless batches from bags, each of which continues the one before; samples are ticks."""

    def __init__(self, reading: Reading, workers: int = 1) -> None:
        """Read in a process beside (`workers` = 1) or between the steps (0); what is read is the same.

        Raises:
            ValueError: If there is to be another number of processes: the memory of a stream goes on from batch to
                batch, so that they come from one reader.
        """
        if workers not in (0, 1):
            raise ValueError(f"workers is {workers}: expected 1, a process beside, or 0, none")
        self._reading, self._workers = reading, workers
        self._place: _Place | None = None
        self._items: Iterator[_Item] | None = None
        self._cpu_seconds = 0.0

    def next_batch(self) -> Batch:
        """Return the next stretch of every stream.

        Raises:
            BagError: If a bag is not what is expected (see `BagStream`).
        """
        if self._items is None:
            with children.sheltered():
                self._items = iter(self._loader())
        item = next(self._items)
        self._place = item.after
        self._cpu_seconds = item.cpu_seconds if self._workers else 0.0
        self.samples += item.batch.valid.size
        return item.batch

    def _loader(self) -> DataLoader[_Item]:
        return DataLoader(
            _Batches(self._reading, self._place),
            batch_size=None,
            num_workers=self._workers,
            prefetch_factor=_AHEAD if self._workers else None,
            collate_fn=_as_is,  # pyright: ignore[reportArgumentType] - one batch at a time, not a list
            worker_init_fn=_begin,
            generator=torch.Generator(),  # else the loader draws from the global one
        )

    def state(self) -> State:
        """Return the place in the bags, which are named, so that others begin anew."""
        if self._place is None:
            return State()
        values = {"bags": [bag.name for bag in self._reading.bags], "streams": self._place.streams}
        return State(values, {"seen": torch.from_numpy(self._place.seen)})

    def restore(self, state: State) -> None:
        """Go on from the place; from the start where the bags are others than before."""
        if state.values.get("bags") == [bag.name for bag in self._reading.bags]:
            self._place = _Place(state.values["streams"], state.tensors["seen"].numpy())

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of the reading process."""
        return self._cpu_seconds

    def close(self) -> None:
        """End the reading process."""
        self._items = None


def _as_is(item: _Item) -> _Item:
    return item


def _begin(_: int) -> None:
    children.end_with_parent()
