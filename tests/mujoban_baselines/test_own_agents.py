"""Agents of one's own: what they need not take or see, and the weights that they start from."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from mujoban_baselines.agents import TopDownAgent
from mujoban_baselines.impala import VTraceTrainingConfig
from mujoban_baselines.mpo import MPOTrainingConfig
from mujoban_baselines.networks import RecurrentAgent, dense
from mujoban_baselines.squares import SquaresTask
from mujoban_baselines.task import TaskConfig
from mujoban_baselines.train import MPORunConfig, VTraceRunConfig, mpo_parts, vtrace_parts
from mujoban_rl.actors import ActorOptions
from mujoban_rl.limits import NaNGuard
from mujoban_rl.weights import save_weights

TASK = TaskConfig(robots=2, levels="easy", episode_seconds=1.0)
SMALL = MPOTrainingConfig(window=6, warm_up=1, n_step=2, windows=4, replay=120, first=1, samples=4)


class Blind(RecurrentAgent):
    """Feels nothing, and sees the map."""

    sees = ("abstract_state",)

    def __init__(self, body="ball"):
        super().__init__(body, 64, 32, [64])
        self.encoder = dense(400, 64)

    @property
    def sense(self):
        return None

    def embed(self, sights):
        return self.encoder(sights["abstract_state"].flatten(1).float())


def test_an_agent_that_takes_its_body_alone_starts_from_its_weights(tmp_path):
    save_weights(tmp_path / "agent.safetensors", Blind(), {"body": "ball"}, {})
    config = MPORunConfig(task=TASK, start=tmp_path / "agent.safetensors", mpo=SMALL)
    learner, source = mpo_parts(config, ActorOptions(), kind=Blind)
    source.close()
    assert learner.agent.training and learner.agent.config == {"body": "ball"}
    with pytest.raises(ValueError, match=r"--repeat 4: .*agent\.safetensors holds weights of repeat 1, expected that"):
        mpo_parts(replace(config, repeat=4), ActorOptions(), kind=Blind)


@pytest.mark.parametrize(("before", "told"), [(None, "pink"), ("pink", None)])
def test_a_run_plays_by_means_or_draws_as_told_whatever_it_starts_from(tmp_path, before, told):
    began = TopDownAgent(repeat=4, draws=before)
    save_weights(tmp_path / "agent.safetensors", began, began.config, {})
    config = MPORunConfig(start=tmp_path / "agent.safetensors", repeat=4, draws=told, critic="symmetric", mpo=SMALL)
    learner, source = mpo_parts(config, ActorOptions(), partial(SquaresTask, batch=2), TopDownAgent)
    source.publish(learner.weights(), 0)
    source.close()
    agent = learner.agent
    assert agent.training and (agent.draws, agent.config.get("draws")) == (told, told) and agent.repeat == 4
    assert all(torch.equal(values, began.state_dict()[name]) for name, values in agent.state_dict().items())


@pytest.mark.parametrize("critic", ["asymmetric", "symmetric", None])
def test_an_agent_learns_that_does_not_see_proprioception(critic):
    if critic is None:
        config = VTraceRunConfig(task=TASK, vtrace=VTraceTrainingConfig(unroll=3))
        learner, source = vtrace_parts(config, Blind, ActorOptions())
    else:
        config = MPORunConfig(task=TASK, critic=critic, mpo=SMALL)
        learner, source = mpo_parts(config, ActorOptions(), kind=Blind)
    source.publish(learner.weights(), 0)
    before = learner.agent.mean.weight.clone()
    told = learner.update(source.next_batch(), 0.0, NaNGuard())
    source.close()
    assert math.isfinite(told["gradient_norm"]) and not torch.equal(learner.agent.mean.weight, before)
