"""Recorded episodes as endless ticks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from mujoban_rl.recordings import EndlessEpisodes, Fields

EPISODES = {"a": (2, 3), "b": (), "c": (4,)}
"""Ticks of the episodes of each recording."""


def _episodes(opened: Counter[str] | None = None, rows: int = 2) -> EndlessEpisodes[str]:
    def read(name: str) -> Iterator[Fields]:
        if opened is not None:
            opened[name] += 1
        for number, length in enumerate(EPISODES[name]):
            yield {"first": np.arange(length) == 0, "at": np.array([(name, number, t) for t in range(length)], object)}

    return EndlessEpisodes(list(EPISODES), read, np.random.default_rng(0), rows)


def _ticks(episodes: EndlessEpisodes[str], count: int) -> list[list[tuple[str, int, int]]]:
    return [[tuple(fields["at"][t]) for fields, t in episodes.next()] for _ in range(count)]


def test_every_row_plays_every_episode_once_a_round_and_in_its_order() -> None:
    opened: Counter[str] = Counter()
    ticks = _ticks(_episodes(opened), 9)
    for row in zip(*ticks, strict=True):
        every = [(n, e, t) for n, lengths in EPISODES.items() for e, m in enumerate(lengths) for t in range(m)]
        assert Counter(row) == Counter(every)
        assert row.index(("a", 1, 2)) == row.index(("a", 0, 0)) + 4
    # An order may end in the empty one, which is looked into only when the next tick is asked for.
    assert opened["a"] == opened["c"] == 2


@pytest.mark.parametrize("played", range(12))
def test_a_resumed_one_goes_on_as_if_it_had_not_stopped(played: int) -> None:
    whole, stopped, resumed = _episodes(), _episodes(), _episodes()
    _ticks(stopped, played)
    resumed.restore(stopped.state())
    assert _ticks(resumed, 30) == _ticks(whole, played + 30)[played:]


def test_with_other_recordings_than_before_all_rows_begin_anew() -> None:
    stopped, whole = _episodes(), _episodes()
    _ticks(stopped, 5)
    stopped._names.pop()
    resumed = _episodes()
    resumed.restore(stopped.state())
    assert _ticks(resumed, 20) == _ticks(whole, 20)


def test_recordings_without_an_episode_are_refused() -> None:
    nothing = EndlessEpisodes(["a", "b"], lambda name: iter(()), np.random.default_rng(0), 1)
    with pytest.raises(ValueError, match="no episode of 2 ticks in 2 bags"):
        nothing.next()
