"""Cloning from recorded bags, and MPO that starts from a clone."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from bringup.command import Choice, Stack
from bringup.rollout import ticks
from bringup.rollout_recorder import Recorder
from mujoban_baselines.agents import MonolithicAgent
from mujoban_baselines.cloning import BagSource, CloningConfig
from mujoban_baselines.mpo import MPOTrainingConfig
from mujoban_baselines.squares import SquaresTask
from mujoban_baselines.train import CloneRunConfig, MPORunConfig, clone_parts, main, make_trainer, mpo_parts
from mujoban_core.bodies import BALL
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES
from mujoban_msgs_py.bags import BagError
from mujoban_msgs_py.bags.training import bags_digest
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence
from mujoban_rl.limits import NaNGuard
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level

TINY = CloningConfig(rows=2, window=4)
EPISODE = 15


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Return a folder of bags of two short episodes of the oracles."""
    folder = tmp_path_factory.mktemp("bags")
    specs = [EpisodeSpec(generate_level(1, seed), seed) for seed in (TRAIN_SEEDS.start, TRAIN_SEEDS.start + 1)]
    policy = Stack({role: Choice(role, "oracle") for role in ROLES}).policy()
    with Recorder(folder, BALL, specs, [1, 1]) as recorder:
        for tick in ticks(policy, World(2, max_boxes=1, time_limit=EPISODE), specs, camera=True):
            recorder.write(tick)
    return folder


def clone(folder, bags):
    config = CloneRunConfig(cloning=TINY)
    return make_trainer(config, clone_parts(config, [bags]), folder, Cadence(2), "cloning")


def test_batches_follow_each_other_through_episodes(bags):
    source = BagSource([bags], MonolithicAgent(), CloningConfig(rows=1, window=10), np.random.default_rng(0))
    batches = [source.next_batch() for _ in range(4)]
    assert batches[0]["frame"].shape == (1, 10, 64, 64, 3)
    first = np.concatenate([batch["first"][0] for batch in batches])
    assert np.flatnonzero(first).tolist() == [0, EPISODE, 2 * EPISODE] and source.samples == 40


def test_bags_of_another_world_and_of_levels_that_are_not_for_training_are_refused_at_once(bags, tmp_path):
    specs = [EpisodeSpec(generate_level(1, 1000), 1000)]
    policy = Stack({role: Choice(role, "oracle") for role in ROLES}).policy()
    with Recorder(tmp_path / "tests", BALL, specs, [1]) as recorder:
        for tick in ticks(policy, World(1, max_boxes=1, time_limit=EPISODE), specs, camera=True):
            recorder.write(tick)
    with pytest.raises(BagError, match="seed 1000, which is not for training"):
        clone(tmp_path / "run", tmp_path / "tests")
    config = CloneRunConfig(cloning=TINY, world="eased")
    with pytest.raises(BagError, match="recorded with the world reference, expected eased"):
        clone_parts(config, [bags])


def test_a_cloning_goes_on_where_it_stopped_and_refuses_nan_with_its_memory(bags, tmp_path):
    make = partial(clone, bags=bags)
    check_resuming(make, tmp_path, stop_at=2, updates=4)
    check_refusal(make(tmp_path / "nan"), lambda batch: {**batch, "action": batch["action"] * math.nan})


def test_torques_are_learned_and_mpo_starts_from_them_with_its_critic(bags, tmp_path):
    run = tmp_path / "run"
    assert main(["clone", "--run", str(run), "--bags", str(bags), "--steps", "200", "--cloning.rows", "2"]) == 0
    settings = MPOTrainingConfig(window=6, warm_up=1, n_step=2, windows=2, replay=60, first=1, critic_first=1)
    record = json.loads((run / "agent.json").read_text())
    assert record["bags_digest"] == bags_digest([bags]) and record["world"] == DEFAULT_WORLD and not record["start"]
    assert "task" not in record["training"], "a cloning plays nothing"
    config = MPORunConfig(start=run / "agent.safetensors", mpo=settings)
    with pytest.raises(ValueError, match=r"--size L: .*agent\.safetensors holds weights of size S, expected that"):
        mpo_parts(replace(config, size="L"), ActorOptions())
    for critic in ("asymmetric", "symmetric"):
        learner, source = mpo_parts(replace(config, critic=critic), ActorOptions(), partial(SquaresTask, batch=2))
        before = {name: values.clone() for name, values in learner.weights().items() if "normaliser" not in name}
        source.publish(learner.weights(), 0)
        learner.update(source.next_batch(), 0.0, NaNGuard())
        assert all((learner.weights()[k] == values).all() for k, values in before.items()), "the critic learns first"
        learner.update(source.next_batch(), 0.0, NaNGuard())
        assert not all((learner.weights()[k] == values).all() for k, values in before.items())
    small = ["--robots", "1", "--episode-seconds", "0.5", "--levels", "easy", "--steps", "1", "--seconds", "0"]
    started = ["--run", str(tmp_path / "mpo"), "--start", str(run / "agent.safetensors")]
    assert main(["monolithic-mpo", *started, *small]) == 0
    record = json.loads((tmp_path / "mpo" / "agent.json").read_text())
    assert record["start"] == digest(run / "agent.safetensors"), "the record tells which weights these come from"
    with pytest.raises(ValueError, match="--bags is missing"):
        main(["clone", "--run", str(tmp_path / "other")])
