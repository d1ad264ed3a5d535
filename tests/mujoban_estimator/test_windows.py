"""Batches of streams, and the windows of instructions in them."""

import numpy as np
from estimator_bags import stretch

from mujoban_core.bodies import BALL
from mujoban_estimator.data import Batcher, choose_windows


def test_windows_are_whole_instructions_from_their_issue_but_for_the_tick_before_any():
    stream = iter([stretch(20, terminated=(6, 10))])
    batch = next(Batcher([stream], 24, BALL))
    windows = choose_windows(batch, 10_000, 64, np.random.default_rng(0))
    found = sorted(w[v].tolist() for w, v in zip(windows.tick, windows.valid, strict=True))
    assert found == [list(range(1, 6)), list(range(6, 10)), list(range(10, 20))]
    assert sorted(windows.tick[:, 0]) == [0, 6, 10]  # the network sees that tick all the same, as in play


def test_windows_do_not_begin_where_the_issue_is_unknown():
    stream = iter([stretch(20, first=False, terminated=(6,))])
    batch = next(Batcher([stream], 20, BALL))
    windows = choose_windows(batch, 10_000, 5, np.random.default_rng(0))
    assert windows.tick[windows.valid].tolist() == [6, 7, 8, 9, 10]


def test_a_stream_that_ends_early_is_padding():
    batches = list(Batcher([iter([stretch(4)]), iter([stretch(8), stretch(3, first=False)])], 8, BALL))
    assert [b.valid.sum(1).tolist() for b in batches] == [[4, 8], [0, 3]]
    assert not batches[1].first[0]


def test_cells_stay_seen_until_the_next_episode():
    away = stretch(4)._replace(pose=np.tile(np.float32([-0.5, 0.5, np.pi]), (4, 1)), first=False)
    batcher = Batcher([iter([stretch(4), away, away._replace(first=True)])], 4, BALL)
    first, second, third = batcher
    assert (second.seen[:, -1] & first.in_view[:, 0]).sum() == first.in_view[:, 0].sum()
    assert not (third.seen[:, -1] & first.in_view[:, 0]).all() and third.seen.sum() < second.seen.sum()
