"""Batches from recorded bags, read in processes beside the training or between its steps."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset

from mujoban_core import children
from mujoban_core.bodies import get_body
from mujoban_core.worker import Worker
from mujoban_estimator.bag_stream import TOPICS, BagStream, KeptBags, stretches
from mujoban_estimator.data import Batch, Batcher, Stretch
from mujoban_msgs_py.bags import BagError
from mujoban_msgs_py.bags.training import ReadReport, bag_digest, open_training_bag
from mujoban_rl.engine import Source, State

_T = TypeVar("_T")
_AHEAD: Final = 2
"""Batches that are read ahead."""
_LAST: Final = 10
"""Seconds that a reading process goes on after a SIGTERM, in which the training ends its update and is saved."""


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


class _Batches(IterableDataset[_Item | BagError]):
    """Endless batches from a place on, or what is wrong with a bag: raised, a loader would add its traceback."""

    def __init__(self, reading: Reading, place: _Place | None, kept: KeptBags | None = None) -> None:
        super().__init__()
        self._reading, self._place, self._kept = reading, place, kept

    def __iter__(self) -> Iterator[_Item | BagError]:
        r = self._reading
        kept = KeptBags() if self._kept is None else self._kept
        streams = [
            BagStream(r.bags, r.length, rng, kept, skip_damaged=r.skip_damaged, allow_test_seeds=r.allow_test_seeds)
            for rng in np.random.default_rng([r.seed, 0]).spawn(r.streams)
        ]
        batcher = Batcher(streams, r.length, get_body(r.body))
        if self._place is not None:
            batcher.seen = self._place.seen.copy()
            for stream, state in zip(streams, self._place.streams, strict=True):
                stream.restore(state)
        try:
            for batch in batcher:
                place = _Place([stream.state() for stream in streams], batcher.seen.copy())
                yield _Item(batch, place, time.process_time())
        except BagError as error:
            yield error


class _Bag(NamedTuple):
    """What a reading process hands over of a bag."""

    stretches: list[Stretch]
    cpu_seconds: float


class _Bags(Dataset[_Bag | BagError]):
    """All bags, one after the other, or what is wrong with one."""

    def __init__(self, reading: Reading) -> None:
        super().__init__()
        self._reading = reading

    def __len__(self) -> int:
        return len(self._reading.bags)

    def __getitem__(self, index: int) -> _Bag | BagError:
        r, start = self._reading, time.process_time()
        try:
            bag = open_training_bag(r.bags[index], TOPICS, skip_damaged=r.skip_damaged)
            gathered = list(stretches(bag, r.length, ReadReport(), allow_test_seeds=r.allow_test_seeds))
        except BagError as error:
            return error
        return _Bag(gathered, time.process_time() - start)


class BagSource(Source[Batch]):
    """Endless batches from bags, each of which continues the one before; samples are ticks."""

    def __init__(self, reading: Reading, workers: int = 1) -> None:
        """Read in a process beside (`workers` = 1) or between the steps (0); what is read is the same.

        Several processes read all bags, as far as they can be kept, when `read_all` is called or the first batch asked
        for; a thread then joins them.

        Raises:
            ValueError: If the number of processes is negative.
        """
        if workers < 0:
            raise ValueError(f"workers is {workers}: expected a number of processes, from 0")
        self._reading, self._workers = reading, workers
        self._digests = [bag_digest(bag) for bag in reading.bags]
        self._place: _Place | None = None
        self._items: Iterator[_Item] | None = None
        self._kept: KeptBags | None = None
        self._cpu_seconds = 0.0

    def next_batch(self) -> Batch:
        """Return the next stretch of every stream.

        Raises:
            BagError: If a bag is not what is expected (see `BagStream`).
        """
        if self._items is None:
            self.read_all()
            self._items = self._open()
        item = next(self._items)
        self._place = item.after
        if self._workers == 1:
            self._cpu_seconds = item.cpu_seconds
        self.samples += item.batch.valid.size
        return item.batch

    def read_all(self) -> None:
        """Read all bags where that is for several processes, which have not done it: before a clock runs, say.

        Raises:
            BagError: If a bag is not what is expected (see `BagStream`).
        """
        if self._workers < 2 or self._kept is not None:
            return
        self._kept = KeptBags()
        with children.sheltered():
            bags = _items(iter(_loader(_Bags(self._reading), self._workers)))
            for path, bag in zip(self._reading.bags, bags, strict=True):
                self._kept.keep(path, bag.stretches)
                self._cpu_seconds += bag.cpu_seconds

    def _open(self) -> Iterator[_Item]:
        batches = _Batches(self._reading, self._place, self._kept)
        if self._kept is not None:
            return _ahead(_items(iter(batches)))
        with children.sheltered():
            return _items(iter(_loader(batches, self._workers)))

    def state(self) -> State:
        """Return the place in the bags, with their digests, so that others begin anew."""
        if self._place is None:
            return State()
        values = {"bags": self._digests, "streams": self._place.streams}
        return State(values, {"seen": torch.from_numpy(self._place.seen)})

    def restore(self, state: State) -> None:
        """Go on from the place; from the start where the bags are others than before."""
        if state.values.get("bags") == self._digests:
            self._place = _Place(state.values["streams"], state.tensors["seen"].numpy())

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of the reading processes."""
        return self._cpu_seconds

    def close(self) -> None:
        """End the reading process."""
        self._items = None


def _loader(dataset: Dataset[_T], workers: int) -> DataLoader[_T]:
    return DataLoader(
        dataset,
        batch_size=None,
        num_workers=workers,
        prefetch_factor=_AHEAD if workers else None,
        collate_fn=_as_is,
        worker_init_fn=_begin,
        generator=torch.Generator(),  # else the loader draws from the global one
    )


def _items(found: Iterator[_T | BagError]) -> Iterator[_T]:
    """Yield what was found, and raise what is wrong with a bag."""
    while (item := next(found, None)) is not None:
        if isinstance(item, BagError):
            del found  # and with it the processes that read, for which the error would keep it
            raise item
        yield item


def _ahead(items: Iterator[_Item]) -> Iterator[_Item]:
    """Yield items that a thread makes ahead."""
    thread = Worker("batches")
    try:
        waiting = deque(thread.submit(next, items) for _ in range(_AHEAD))
        while True:
            item = waiting.popleft().result()
            waiting.append(thread.submit(next, items))
            yield item
    finally:
        thread.drop()
        thread.end()


def _as_is(item: Any) -> Any:
    return item


def _begin(_: int) -> None:
    children.end_with_parent()
    children.outlast(_LAST)
