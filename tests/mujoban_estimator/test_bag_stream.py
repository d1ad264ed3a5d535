"""Recorded bags as streams of episodes."""

import shutil

import numpy as np
import pytest
from estimator_bags import LENGTHS, SEED, copy_without, made_up_ticks

from bringup.record import MixedEpisodes
from bringup.rollout_recorder import TOPICS as RECORDED
from bringup.rollout_recorder import Recorder
from mujoban_core.bodies import BALL
from mujoban_core.grid import Instruction
from mujoban_estimator.bag_stream import TOPICS, BagStream, KeptBags, stretches
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError, BagWriter
from mujoban_msgs_py.bags.training import ReadReport, find_bags, open_training_bag, require_training_seeds


def test_a_bag_gives_back_the_episodes_in_stretches(bags):
    report = ReadReport()
    found = list(stretches(open_training_bag(find_bags([bags])[0], TOPICS), 8, report))
    assert [len(s.frame) for s in found] == [7, 8, 4]
    assert [s.first for s in found] == [True, True, False]
    assert [int(m) for s in found for m in s.frame[:, 0, 0, 0]] == [*range(7), *range(20, 32)]
    assert report.ticks == 19 and report.episodes == 2 and not report.skipped


def test_instruction_and_termination_are_those_of_the_tick_before(bags):
    first = next(stretches(open_training_bag(find_bags([bags])[0], TOPICS), 8, ReadReport()))
    assert first.instruction.tolist() == [Instruction.STAY, 1, 1, 1, 1, 2, 2]
    assert np.flatnonzero(first.terminated).tolist() == [5]
    assert np.flatnonzero(first.completed).tolist() == [3]


def test_recorded_bags_hold_every_topic_of_the_graph(bags):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    assert set(bag.topics) == {t.name for t in RECORDED}
    assert set(topics.GRAPH_TOPICS) - set(bag.topics) == {topics.TOP_CAMERA.name}
    assert bag.topics[topics.EPISODE.name].count == sum(LENGTHS) + len(LENGTHS)


def test_a_missing_topic_is_named(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    copy_without(bag, tmp_path / "bag", lambda topic, _: topic == topics.TRUE_TERMINATION.name)
    with pytest.raises(BagError, match=topics.TRUE_TERMINATION.name):
        open_training_bag(tmp_path / "bag", TOPICS)


def test_behind_a_missing_tick_an_episode_is_not_used(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    gone = 3 * topics.TICK
    copy_without(bag, tmp_path / "bag", lambda topic, stamp: topic == topics.CAMERA.name and stamp == gone)
    report = ReadReport()
    found = list(stretches(open_training_bag(tmp_path / "bag", TOPICS), 64, report))
    assert [len(s.frame) for s in found] == [2, 12]
    assert sum(report.skipped.values()) == 4


@pytest.mark.parametrize("twice", [1, 2, 4])
def test_a_tick_that_stands_twice_in_a_bag_is_used_once_and_what_follows_too(bags, tmp_path, twice):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    messages = list(bag.messages())
    with BagWriter(tmp_path / "bag", RECORDED) as writer:
        for stamp in sorted({message.stamp for message in messages}):
            for _ in range(2 if stamp == twice * topics.TICK else 1):
                for message in messages:
                    if message.stamp == stamp:
                        writer.write(message.topic, stamp, message.data)
    report = ReadReport()
    found = list(stretches(open_training_bag(tmp_path / "bag", TOPICS), 64, report))
    assert [len(s.frame) for s in found] == [7, 12]
    assert report.skipped == {"that stand there twice": 1} and report.episodes == 2


def test_a_bag_that_begins_amid_an_episode_is_used_from_the_next_start(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    copy_without(bag, tmp_path / "bag", lambda _, stamp: stamp is not None and stamp <= 2 * topics.TICK)
    found = list(stretches(open_training_bag(tmp_path / "bag", TOPICS), 64, ReadReport()))
    assert [len(s.frame) for s in found] == [12]


def test_paths_without_bags_are_named(tmp_path):
    with pytest.raises(BagError, match="nowhere"):
        find_bags([tmp_path / "nowhere"])
    with pytest.raises(BagError, match="no bag in"):
        find_bags([tmp_path])


@pytest.mark.parametrize(
    ("seed", "difficulty", "named"),
    [(1000, 1, "seed 1000"), (5_000_000, 1, "seed 5000000"), (SEED, 0, "whose level comes from a file")],
)
def test_episodes_that_are_not_for_training_are_refused(tmp_path, seed, difficulty, named):
    episodes = MixedEpisodes(1, seed, [1])
    with Recorder(tmp_path, BALL, episodes, [difficulty]) as recorder:
        for tick in made_up_ticks(episodes, (5,)):
            recorder.write(tick)
    paths = find_bags([tmp_path])
    with pytest.raises(BagError, match=named):
        require_training_seeds(open_training_bag(paths[0], TOPICS))
    with pytest.raises(BagError, match=named):
        next(BagStream(paths, 8, np.random.default_rng(0)))
    assert next(BagStream(paths, 8, np.random.default_rng(0), allow_test_seeds=True)).first


def same(ours, theirs):
    return all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_a_bag_is_read_once_while_it_is_kept_and_streams_side_by_side_stay_within_the_limit(bags, tmp_path):
    shutil.copytree(find_bags([bags])[0], tmp_path / "bag")
    reader = stretches(open_training_bag(tmp_path / "bag", TOPICS), 8, ReadReport())
    size = sum(values.nbytes for s in reader for values in s if isinstance(values, np.ndarray))

    def streams(limit):
        kept = KeptBags(limit)
        return [BagStream([tmp_path / "bag"], 8, np.random.default_rng(i), kept) for i in range(2)]

    room, tight = streams(size), streams(size - 1)
    # In turn, so that both gather the bag at once and neither has room for all of it.
    first = [next(stream) for _ in range(3) for stream in room + tight]
    again = [next(stream) for _ in range(3) for stream in room + tight]
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    for stream in room:
        [next(stream) for _ in range(3)]
    shutil.rmtree(tmp_path / "bag")
    assert all(same(next(stream), first[0]) for stream in room)
    for stream in tight:
        with pytest.raises(BagError):
            [next(stream) for _ in range(4)]


def test_a_stream_goes_on_amid_a_bag_that_was_kept(bags):
    paths = find_bags([bags])
    stream = BagStream(paths, 8, np.random.default_rng(0))
    for _ in range(4):
        next(stream)
    resumed = BagStream(paths, 8, np.random.default_rng(5))
    resumed.restore(stream.state())
    assert all(same(next(resumed), next(stream)) for _ in range(6))
