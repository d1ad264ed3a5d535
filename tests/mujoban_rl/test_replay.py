import numpy as np
import pytest
import torch

from mujoban_rl.replay import SequenceBuilder, SequenceReplay, TickReplay, steps_per_update


def filled(replay, builder, ticks, rows=3):
    for tick in range(ticks):
        sequence = builder.add({"value": torch.arange(rows) * 1000 + tick, "frame": np.full((rows, 2), tick % 256)})
        if sequence is not None:
            replay.add(sequence)
    return replay


def test_windows_are_successive_ticks_of_one_environment_and_begin_at_every_tick_equally_often():
    replay = filled(SequenceReplay(12, 8), SequenceBuilder(8, 2), 8 + 6 * 9)
    # Four sequences of each of three environments are left, and 6 windows of 3 ticks begin in each.
    window = replay.sample(7200, torch.Generator().manual_seed(0), 3)["value"]
    assert torch.equal(window[:, 1:], window[:, :-1] + 1)
    starts, counts = np.unique(window[:, 0].numpy(), return_counts=True)
    assert starts.tolist() == [row * 1000 + tick for row in range(3) for tick in range(36, 60)]
    assert counts.min() > 60 and counts.max() < 140
    assert replay.sample(2, torch.Generator())["frame"].shape == (2, 8, 2)


@pytest.mark.parametrize(("length", "starts"), [(8, range(30)), (4, range(0, 36, 4))])
def test_windows_of_ticks_begin_at_every_tick_also_where_a_sequence_ends(length, starts):
    replay = TickReplay(12, length, window=4)
    for tick in range(36):
        replay.add({"value": np.array([tick])})
    window = replay.sample(3300, torch.Generator().manual_seed(0))["value"]
    assert torch.equal(window[:, 1:], window[:, :-1] + 1)
    found, counts = np.unique(window[:, 0].numpy(), return_counts=True)
    # Of eight ticks, the sixth sequence ends at tick 32, and what follows waits for the seventh.
    assert found.tolist() == list(starts)
    assert counts.min() > 0.6 * counts.mean() and counts.max() < 1.4 * counts.mean()


def test_each_step_is_learned_from_as_often_as_is_asked_for():
    windows, ticks, reuse, updates = 8, 5, 2.5, 100
    steps = updates * steps_per_update(windows, ticks, reuse)
    assert updates * windows * ticks == reuse * steps


def test_a_replay_and_a_builder_go_on_where_they_were():
    whole, builder = filled(SequenceReplay(7, 4), SequenceBuilder(4, 1), 9), SequenceBuilder(4, 1)
    filled(whole, builder, 6)
    other, waiting = SequenceReplay(7, 4), SequenceBuilder(4, 1)
    other.restore(whole.state())
    waiting.restore(builder.state())
    for replay, ticks in ((whole, builder), (other, waiting)):
        filled(replay, ticks, 5)
    assert len(whole) == len(other) == 7
    one, two = (replay.sample(50, torch.Generator().manual_seed(0)) for replay in (whole, other))
    assert torch.equal(one["value"], two["value"]) and torch.equal(one["frame"], two["frame"])


@pytest.mark.parametrize(("capacity", "kept"), [(3, range(6, 9)), (5, range(4, 9)), (20, range(4, 9))])
def test_a_replay_of_another_capacity_goes_on_with_the_newest_of_what_was_held(capacity, kept):
    full, other = SequenceReplay(5, 1), SequenceReplay(capacity, 1)
    for value in range(9):
        full.add({"value": np.array([[value]])})
    other.restore(full.state())
    assert len(other) == len(kept)
    assert set(other.sample(300, torch.Generator().manual_seed(0))["value"].flatten().tolist()) == set(kept)
    for value in range(9, 9 + capacity):
        assert other.sample(300, torch.Generator().manual_seed(0))["value"].min() == max(4, value - capacity)
        other.add({"value": np.array([[value]])})


def test_the_last_sequences_stay_where_more_come_than_fit():
    replay = SequenceReplay(2, 1)
    replay.add({"value": np.arange(5)[None]})
    assert set(replay.sample(50, torch.Generator())["value"].flatten().tolist()) == {3, 4}


def test_what_does_not_fit_a_replay_is_named():
    replay, generator = SequenceReplay(2, 3), torch.Generator()
    with pytest.raises(ValueError, match="empty: add sequences"):
        replay.sample(1, generator)
    with pytest.raises(ValueError, match="value has 2 ticks: expected 3"):
        replay.add({"value": np.zeros((2, 1))})
    replay.add({"value": np.zeros((3, 1))})
    with pytest.raises(ValueError, match="expected \\['value'\\]"):
        replay.add({"other": np.zeros((3, 1))})
    with pytest.raises(ValueError, match="window of 4 ticks: expected 1 to 3"):
        replay.sample(1, generator, 4)
    with pytest.raises(ValueError, match="overlap of 3 ticks: expected 0 to 2"):
        SequenceBuilder(3, 3)
    with pytest.raises(ValueError, match="capacity 0"):
        SequenceReplay(0, 3)
