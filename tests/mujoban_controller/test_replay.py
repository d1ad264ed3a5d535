"""The sequence replay keeps sequences whole and forgets the oldest."""

from __future__ import annotations

import numpy as np
import pytest

from mujoban_controller.replay import SequenceReplay


def sequences(first, batch=2, length=3):
    x = first + np.arange(batch)[None] + 10 * np.arange(length)[:, None]
    return {"x": x}, {"h": first + np.arange(batch, dtype=np.float32)}


def test_ticks_of_a_sequence_stay_together_with_the_memory_at_its_start():
    replay = SequenceReplay(8, 3)
    replay.add(*sequences(100))
    batch = replay.sample(16, np.random.default_rng(0))
    assert batch["x"].shape == (16, 3)
    assert (batch["x"][:, 0] == batch["h"]).all()
    assert (batch["x"].diff(dim=1) == 10).all()


def test_the_oldest_sequences_are_overwritten():
    replay = SequenceReplay(4, 3)
    for first in (100, 200, 300):
        replay.add(*sequences(first))
    assert replay.size == 4
    seen = set(replay.sample(200, np.random.default_rng(0))["h"].tolist())
    assert seen == {200.0, 201.0, 300.0, 301.0}


def test_sequences_of_another_length_are_refused():
    with pytest.raises(ValueError, match="x has 2 ticks: expected 3"):
        SequenceReplay(4, 3).add(*sequences(0, length=2))


def test_an_empty_replay_has_nothing_to_sample():
    with pytest.raises(ValueError, match="empty"):
        SequenceReplay(4, 3).sample(1, np.random.default_rng(0))
