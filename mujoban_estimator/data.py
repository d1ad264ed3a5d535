"""What a tick of a recording holds for training, in stretches of one episode each (paper C.1, C.4).

Shapes: S streams, T ticks of a stretch, P proprioceptive values, W windows of V ticks, each within one instruction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_core.grid import GRID_SIZE, WALL
from mujoban_core.visibility import cells_in_view


class Stretch(NamedTuple):
    """Consecutive ticks of one episode."""

    frame: NDArray[np.uint8]
    """o_cam, [T, 64, 64, 3]."""
    pose: NDArray[np.float32]
    """o_pos, (x [m], y [m], psi [rad]) in the map frame, [T, 3]."""
    proprio: NDArray[np.float32]
    """o_pr, [T, P]."""
    instruction: NDArray[np.int64]
    """A_{t-1}, [T]."""
    terminated: NDArray[np.bool_]
    """beta_{t-1}, [T]."""
    completed: NDArray[np.bool_]
    """Whether A_{t-1} is completed by the rule of C.4, [T]."""
    abstract_state: NDArray[np.float32]
    """True s_abst, [T, 10, 10, 4]."""
    first: bool
    """Whether the stretch begins with the episode's first tick."""


class Batch(NamedTuple):
    """Stretches of S streams, padded to the same length; the fields are those of `Stretch`."""

    frame: NDArray[np.uint8]
    pose: NDArray[np.float32]
    proprio: NDArray[np.float32]
    instruction: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    completed: NDArray[np.bool_]
    abstract_state: NDArray[np.float32]
    valid: NDArray[np.bool_]
    """Whether a tick is no padding, [S, T]."""
    first: NDArray[np.bool_]
    """Whether a stream begins an episode here, so that its memory must start afresh, [S]."""
    in_view: NDArray[np.bool_]
    """Cells in view, [S, T, 10, 10]."""
    seen: NDArray[np.bool_]
    """Cells that are or were in view in the episode, [S, T, 10, 10]."""


class Windows(NamedTuple):
    """Stretches of ticks that each belong to one instruction and begin when it is issued."""

    stream: NDArray[np.int64]
    """[W]."""
    tick: NDArray[np.int64]
    """Ticks within the batch, padded by repeating the last, [W, V]."""
    valid: NDArray[np.bool_]
    """Whether a tick counts, [W, V]: it is no padding, and not an episode's first, at which nothing is in force."""


def choose_windows(batch: Batch, frames: int, length: int, rng: np.random.Generator) -> Windows:
    """Draw instructions that begin within a batch until their ticks number `frames`.

    Args:
        batch: the batch.
        frames: about how many ticks to take.
        length: most ticks of one instruction.
        rng: source of the choice.
    """
    starts = batch.terminated & batch.valid
    starts[:, 0] |= batch.first
    ends = batch.valid.sum(axis=1)
    stream, tick = np.nonzero(starts)
    following = np.append(tick[1:], 0)
    same = np.append(stream[1:] == stream[:-1], False)
    count = np.minimum(np.where(same, following, ends[stream]) - tick, length)
    order = rng.permutation(len(stream))
    chosen = order[np.cumsum(count[order]) - count[order] < frames]
    steps = np.arange(count[chosen].max(initial=1))
    ticks = tick[chosen, None] + np.minimum(steps, count[chosen, None] - 1)
    begins = batch.first[stream[chosen], None] & (ticks == 0)
    return Windows(stream[chosen], ticks, (steps < count[chosen, None]) & ~begins)


class Batcher:
    """Joins streams of stretches into batches, and remembers per stream which cells have been seen."""

    def __init__(self, streams: Sequence[Iterator[Stretch]], length: int, body: Body) -> None:
        """Join streams; every stretch is padded to `length` ticks by repeating its last."""
        self._streams = list(streams)
        self._length = length
        self._body = body
        self.seen = np.zeros((len(streams), GRID_SIZE, GRID_SIZE), np.bool_)
        """Cells that were in view earlier in each stream's episode, [S, 10, 10]; what a batch depends on before it."""

    def __iter__(self) -> Iterator[Batch]:
        """Return itself: batches come until every stream has ended."""
        return self

    def __next__(self) -> Batch:
        """Return the next stretch of every stream; streams that have ended are padding."""
        stretches = [next(stream, None) for stream in self._streams]
        some = next((s for s in stretches if s is not None), None)
        if some is None:
            raise StopIteration
        present = [some if s is None else s for s in stretches]
        padded = [
            np.stack([_pad(s[i], self._length) for s in present])  # pyright: ignore[reportArgumentType]
            for i in range(len(Stretch._fields) - 1)
        ]
        first = np.array([s is not None and s.first for s in stretches])
        count = np.array([0 if s is None else len(s.frame) for s in stretches])
        valid = np.arange(self._length) < count[:, None]
        in_view = self._look(padded[6], padded[1])
        self.seen[first] = False
        seen = np.logical_or.accumulate(in_view, axis=1) | self.seen[:, None]
        self.seen = seen[:, -1].copy()
        return Batch._make([*padded, valid, first, in_view, seen])

    def _look(self, abstract_state: NDArray[np.float32], pose: NDArray[np.float32]) -> NDArray[np.bool_]:
        wall = abstract_state[..., WALL].reshape(-1, GRID_SIZE, GRID_SIZE) > 0.5
        view = cells_in_view(wall, pose.reshape(-1, 3), self._body.camera, self._body.cell_size)
        return view.reshape(*pose.shape[:2], GRID_SIZE, GRID_SIZE)


def _pad(values: NDArray, length: int) -> NDArray:
    """Repeat the last of `values` until there are `length`."""
    if len(values) == length:
        return values
    return values[np.minimum(np.arange(length), len(values) - 1)]
