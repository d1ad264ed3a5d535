"""Which training seeds the trainers of the planner play: each actor of each run has a stream of its own."""

from __future__ import annotations

from typing import Final

from mujoban_sokoban.generator import TRAIN_SEEDS

_SEEDS: Final = 10**12
"""Seeds of a stream, more than any run plays."""
_STREAMS_PER_SEED: Final = 1000
"""Streams that one run may use up, one for each actor."""
LESSONS: Final = range(600_000)
"""Streams of imitation's lessons."""
MOVES: Final = range(600_000, 700_000)
"""Streams of play over moves."""
LEVELS: Final = range(700_000, len(TRAIN_SEEDS) // _SEEDS)
"""Streams of what search and play over pushes draw."""


def last_seed(streams: range) -> int:
    """Return the largest seed of a run whose every stream, among `LESSONS`, `MOVES` or `LEVELS`, has levels."""
    return len(streams) // _STREAMS_PER_SEED - 1


LAST_SEED: Final = last_seed(LEVELS)
"""That of a run by search, or over pushes."""


def check_seed(seed: int, streams: range) -> None:
    """Raise ValueError unless a run with this seed has training levels of its own."""
    if not 0 <= seed <= last_seed(streams):
        raise ValueError(f"seed is {seed}: expected 0 to {last_seed(streams)}, as there are no levels for others")


def stream_number(seed: int, stream: int) -> int:
    """Return which of all runs' streams an actor has: the `stream`-th of a run with this seed.

    Raises:
        ValueError: If the seed is negative, or has no such stream.
    """
    if seed < 0 or not 0 <= stream < _STREAMS_PER_SEED:
        raise ValueError(f"stream {stream} of seed {seed}: expected 0 to {_STREAMS_PER_SEED - 1} of a seed from 0 on")
    return _STREAMS_PER_SEED * seed + stream


def first_seed(streams: range, number: int) -> int:
    """Return the first training seed of a stream, by its number among `LESSONS`, `MOVES` or `LEVELS`.

    Raises:
        ValueError: If there is no such stream.
    """
    if not 0 <= number < len(streams):
        last = last_seed(streams)
        raise ValueError(f"stream {number}: expected 0 to {len(streams) - 1}, those of the seeds 0 to {last} of runs")
    return TRAIN_SEEDS.start + streams[number] * _SEEDS
