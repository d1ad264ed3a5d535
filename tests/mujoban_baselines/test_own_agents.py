"""Agents of one's own: what they need not see."""

import math

import pytest
import torch

from mujoban_baselines.impala import VTraceTrainingConfig
from mujoban_baselines.mpo import MPOTrainingConfig
from mujoban_baselines.networks import RecurrentAgent, dense
from mujoban_baselines.task import TaskConfig
from mujoban_baselines.train import MPORunConfig, VTraceRunConfig, mpo_parts, vtrace_parts
from mujoban_rl.actors import ActorOptions
from mujoban_rl.limits import NaNGuard

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
