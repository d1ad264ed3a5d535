"""Searches and play over pushes on a Ray cluster that runs on this machine, for real."""

import math

import pytest
import torch

from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.push_actor import PlayConfig
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_planner.search_lessons import SearchConfig
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence

SIZE = {"channels": 8, "blocks": 1, "cpu_seconds": 1e9, "updates": 3}
PLAY = PlayConfig(environments=16, steps=4)
CADENCE = Cadence(publish_updates=1, save_seconds=math.inf)


def search(path, actors):
    config = SearchConfig(trees=16, expansions=20, buffer=4000, steps=16, batch_size=32)
    return expert_iteration(
        ExpertIterationConfig(search=config, first_evaluations=1024, **SIZE), path, CADENCE, actors
    )


def play(path, actors):
    return push_ppo(PushPPOConfig(play=PLAY, minibatch=32, **SIZE), path, CADENCE, actors)


@pytest.mark.parametrize("make", [search, play])
def test_actors_on_a_cluster_teach_what_actors_in_this_process_do(make, tmp_path, ray_cluster):
    runs = {}
    for place in ("local", "ray"):
        trainer = make(tmp_path / place, ActorOptions(place, 1, "ordered"))
        trainer.learner.evaluate = dict
        assert trainer.run() and trainer.progress.updates == 3
        runs[place] = trainer
    assert runs["ray"].source.worker_cpu_seconds() > 0.0, "the work was done elsewhere"
    one, other = (dict(run.learner.weights()) for run in runs.values())
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
