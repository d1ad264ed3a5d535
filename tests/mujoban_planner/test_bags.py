"""What the planner learns from recorded bags: the decisions of a running stack, labelled by the solver or by reward."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bringup.command import Choice, Stack
from bringup.record import Job, MixedEpisodes, record
from mujoban_core.plugins import ROLES
from mujoban_core.program import exit_status
from mujoban_msgs_py.bags import BagError
from mujoban_planner import train
from mujoban_planner.bag_lessons import BagLessons, Lessons
from mujoban_planner.bag_transitions import BagTransitions
from mujoban_planner.imitation import ImitationConfig, imitation
from mujoban_planner.lesson_source import LessonActor
from mujoban_planner.reinforcement import MoveStore, MPOConfig, reinforcement
from mujoban_rl.engine import CARRIED
from mujoban_rl.run_directory import copy_light
from mujoban_rl.testing import check_resuming
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level
from mujoban_sokoban.solver import solve_level

pytestmark = pytest.mark.usefixtures("short_validation")


def play_and_record(path, seed, look_around=0):
    stack = Stack({role: Choice(role, "oracle") for role in ROLES}, look_around=look_around)
    assert record(Job(path, "", MixedEpisodes(1, seed, [1]), stack, None, 1, 400, 0))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags")
    play_and_record(path, TRAIN_SEEDS.start)
    return path


def test_decisions_are_labelled_by_the_truth_and_shown_as_they_were_estimated(bags):
    lessons = Lessons.read([bags], 0)
    shown = (lessons.samples.right > 0) & lessons.estimated
    assert shown.sum() == len(solve_level(generate_level(1, TRAIN_SEEDS.start)).moves)
    # The oracle's estimates are the truth; here they are made less sure, to tell them from it.
    doubtful = Lessons(
        lessons.samples.take(shown), lessons.estimates[shown] * np.float16(0.75), lessons.estimated[shown]
    )
    as_estimated, as_it_was = (BagLessons(doubtful, 64, share, 0).next_batch() for share in (1.0, 0.0))
    torch.testing.assert_close(as_estimated.state, 0.75 * as_it_was.state)
    assert torch.equal(as_estimated.right, as_it_was.right) and bool(as_it_was.right.any(1).all())
    assert len(as_it_was.state.unique(dim=0)) > shown.sum()  # the board is turned as well


def test_looking_around_counts_as_decisions_only_where_stays_are_asked_for(tmp_path):
    play_and_record(tmp_path, TRAIN_SEEDS.start, look_around=12)
    every, moves = (Lessons.read([tmp_path], 0, stays=stays).estimated.sum() for stays in (True, False))
    assert moves == len(solve_level(generate_level(1, TRAIN_SEEDS.start)).moves)
    assert every > moves


def test_levels_that_are_kept_for_tests_are_refused(tmp_path):
    play_and_record(tmp_path, 5)
    with pytest.raises(BagError, match="seed 5, which is not for training"):
        Lessons.read([tmp_path], 0)


def imitating(path, bags, share):
    config = ImitationConfig(channels=8, blocks=1, batch_size=16, buffer=50_000, levels=16, stock=4, bag_share=share)
    return imitation(config, path, bags=[bags])


def reinforced(path, bags, share):
    config = MPOConfig(channels=8, blocks=1, environments=8, batch_size=8, target_period=2, bag_share=share)
    return reinforcement(config, path, bags=[bags])


@pytest.mark.parametrize("make", [imitating, reinforced])
def test_runs_from_bags_alone_make_nothing_else_and_resume_to_the_bit(make, bags, tmp_path, monkeypatch):
    for other in ("imitation.LessonSource", "reinforcement.MoveActor"):
        monkeypatch.setattr(f"mujoban_planner.{other}", None)
    check_resuming(lambda path: make(path, bags, 1.0), tmp_path, stop_at=3, updates=6)


def test_lessons_and_bags_share_a_batch_and_resume_to_the_bit(bags, tmp_path):
    trainers = []

    def make(path):
        trainers.append(imitating(path, bags, 0.25))
        return trainers[-1]

    check_resuming(make, tmp_path, stop_at=2, updates=4)
    assert trainers[0].progress.samples == 4 * 16


def test_a_run_with_bags_that_goes_on_from_a_light_copy_has_lessons_of_other_levels(bags, tmp_path, monkeypatch):
    streams = []

    class Noted(LessonActor):
        def __init__(self, config, network, stream, *, device):
            streams.append(stream)
            super().__init__(config, network, stream, device=device)

    monkeypatch.setattr("mujoban_planner.imitation.LessonActor", Noted)
    imitating(tmp_path / "run", bags, 0.25).run(limit_updates=1)
    copy_light(tmp_path / "run", tmp_path / "light", CARRIED)
    imitating(tmp_path / "light", bags, 0.25).run(limit_updates=2)
    assert streams == [0, 1]


@pytest.mark.parametrize(("share", "expected"), [(0.05, 1), (0.25, 2), (0.9, 7)])
def test_a_batch_has_its_share_of_recorded_transitions_and_one_at_least(share, expected):
    config = MPOConfig(environments=2, replay_steps=16, play=8, n_step=1, batch_size=8, bag_share=share)
    state = torch.zeros(3, 10, 10, 4)
    reward, no = torch.full((3,), 5.0), torch.zeros(3, dtype=torch.bool)
    store = MoveStore(config, BagTransitions(state, torch.ones(3, dtype=torch.int64), reward, state, no))
    played = {"reward": np.zeros((9, 2), np.float32), "instruction": np.zeros((9, 2), np.int64)}
    played |= {name: np.zeros((9, 2), np.bool_) for name in ("terminated", "dropped")}
    store.replay.add({**played, "state": np.zeros((9, 2, 10, 10, 4), np.float32)})
    batch = store.sample()
    assert len(batch.reward) == 8 and int((batch.reward == 5.0).sum()) == expected


def test_what_is_no_share_is_refused():
    for config in (ImitationConfig, MPOConfig):
        for share in (1.5, 0.0, math.nan):
            with pytest.raises(ValueError, match=rf"--bag-share {share}: expected a share above 0, at most 1$"):
                config(bag_share=share)


@pytest.mark.parametrize("method", ["imitation", "mpo"])
def test_a_share_of_no_bags_is_refused(method, tmp_path, capsys):
    arguments = [method, "--run", str(tmp_path / "run"), "--bag-share", "1"]
    assert exit_status("train", lambda: train.main(arguments)) == 2
    assert capsys.readouterr().err == "train: error: --bag-share 1: expected --bags, whose share it is\n"
