"""Interrupted recordings in this process, at moments that no signal from outside meets reliably."""

import signal

import numpy as np
import pytest

from bringup import cluster
from bringup import record as recording
from bringup.command import Choice, Stack
from bringup.record import Job, MixedEpisodes, Options, _job, record
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.plugins import ROLES
from mujoban_core.signals import Interrupted, interruptible
from mujoban_estimator.bag_stream import TOPICS, stretches
from mujoban_msgs_py.bags import open_bag
from mujoban_msgs_py.bags.training import ReadReport, find_bags, open_training_bag
from mujoban_sim.world import World
from mujoban_sokoban.generator import TRAIN_SEEDS

BATCH = 4


class Signalling(MixedEpisodes):
    """Episodes that ask the process to end while the second of their levels is drawn."""

    def __init__(self, lost: bool) -> None:
        super().__init__(BATCH, TRAIN_SEEDS.start, [1])
        self.lost, self.drawn = lost, []

    def _make(self, index):
        self.drawn.append(index)
        if index == 1:
            if self.lost:
                Farewell()
            else:
                signal.raise_signal(signal.SIGTERM)
        return super()._make(index)


class Farewell:
    """Is deleted while a signal comes."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


@pytest.fixture
def interrupted(tmp_path):
    def play(episodes):
        stack = Stack({role: Choice(role, "oracle") for role in ROLES})
        job = Job(tmp_path / "bags", "", episodes, stack, None, BATCH, 50, 0)
        with interruptible(), pytest.raises(Interrupted):
            record(job)
        return job.out

    return play


def test_a_recording_that_is_interrupted_while_levels_are_drawn_draws_no_others(interrupted):
    episodes = Signalling(lost=False)
    interrupted(episodes)
    assert episodes.drawn == [0, 1], "hard levels take seconds each"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_that_is_lost_in_a_destructor_ends_the_recording_before_it_writes(interrupted):
    assert not list(interrupted(Signalling(lost=True)).glob("*"))


def test_a_recording_has_the_threads_of_the_networks_in_its_physics_too(tmp_path, monkeypatch):
    asked = []

    def world(*rows, **options):
        asked.append(options["threads"])
        return World(*rows, **options)

    monkeypatch.setattr(recording, "World", world)
    stack = Stack({role: Choice(role, "oracle") for role in ROLES}, threads=2)
    record(Job(tmp_path, "", MixedEpisodes(1, TRAIN_SEEDS.start, [1]), stack, None, 1, 2, 0))
    assert asked == [2]


def test_a_recording_on_a_cluster_asks_for_the_gpu_that_it_uses(tmp_path, monkeypatch):
    asked = []

    def spread(function, jobs, address, **options):
        asked.append((options["cpus"], options["gpus"]))
        return [5 for _ in jobs]

    monkeypatch.setattr(recording, "spread", spread)
    for device in ("cpu", "cuda:0"):
        stack = Stack({role: Choice(role, "oracle") for role in ROLES}, device=device, threads=3)
        job = Job(tmp_path, "", MixedEpisodes(1, TRAIN_SEEDS.start, [1]), stack, None, 1, 2, 0)
        assert recording._record_all([job, job], cluster.HERE, lambda _: None) == 10
    assert asked == [(3.0, 0.0), (3.0, 1.0)]


def test_the_randomness_of_modules_follows_from_no_levels_seed(tmp_path):
    def drawn(seed, run_seed=0):
        options = Options(tmp_path, run_seed=run_seed, processes=2)
        return [_job(options, seed, part).run_seed for part in range(2)]

    assert drawn(10_000_000) == drawn(20_000_000)
    assert len({*drawn(10_000_000), *drawn(10_000_000, 1)}) == 4


def test_what_a_recording_draws_does_not_follow_from_a_level():
    episodes = MixedEpisodes(50, 7, list(DIFFICULTIES))
    drawn = [episodes.difficulty(i) for i in range(50)]
    for difficulty in DIFFICULTIES:
        # The random numbers of which levels are generated.
        streams = [np.random.default_rng([difficulty, seed]) for seed in range(7, 57)]
        assert drawn != [list(DIFFICULTIES)[int(rng.integers(len(DIFFICULTIES)))] for rng in streams]


@pytest.mark.parametrize(("late", "after"), [(False, {1}), (True, set(range(2, 10)))])
def test_recordings_with_late_ends_go_on_after_an_instruction_is_completed(late, after, tmp_path):
    options = Options(tmp_path, undisturbed=not late, late_ends=late)
    stack = Stack({role: Choice(role, "oracle") for role in ROLES})
    record(Job(tmp_path, "", MixedEpisodes(1, TRAIN_SEEDS.start, [3]), stack, options.disturbance, 1, 400, 0))
    (bag,) = find_bags([tmp_path])
    (ticks,) = stretches(open_training_bag(bag, TOPICS), 1000, ReadReport())
    instructions = np.split(ticks.completed, np.flatnonzero(ticks.terminated))[1:-1]
    assert len(instructions) > 3 and {int(completed.sum()) for completed in instructions} <= after
    with pytest.raises(ValueError, match="expected one of them"):
        Options(tmp_path, undisturbed=True, late_ends=True)


@pytest.mark.parametrize("oracle", ["planner", ""])
def test_a_recording_and_its_bags_name_who_is_told_the_truth(oracle, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recording, "_record_all", lambda jobs, cluster, on_end: record(jobs[0]))
    roles = ("--oracle", oracle) if oracle else ()
    recording.main(["--out", str(tmp_path), "--episodes", "1", "--difficulty", "1", "--time-limit", "2", *roles])
    (bag,) = find_bags([tmp_path])
    assert open_bag(bag).about["privileged"] == (oracle or "none")
    count, *others = capsys.readouterr().out.splitlines()
    assert count == "2 ticks of 1 episodes in 1 bags"
    assert others == (["privileged, told the ground truth: planner: oracle"] if oracle else [])


@pytest.mark.parametrize("share", [-0.1, 2.0, np.nan])
def test_a_share_of_advanced_episodes_that_is_none_is_refused(share, tmp_path):
    with pytest.raises(ValueError, match=rf"^--advanced {share}: expected a share, from 0 to 1$"):
        Options(tmp_path, advanced=share)
