"""Continuous MPO against problems whose solution is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from mujoban_rl.losses.mpo import Duals, improve, scalars
from mujoban_rl.losses.mpo_continuous import MPOConfig, MPOLoss, action_cost
from mujoban_rl.losses.returns import td_target


class Bandit:
    """A policy over one state's actions, trained with exact values."""

    def __init__(self, value, *, size=2, config=None, initial_scale=0.5, rate=1e-2, seed=0):
        self.generator = torch.Generator().manual_seed(seed)
        self.value = value
        self.mean = nn.Parameter(torch.zeros(size))
        self.log_scale = nn.Parameter(torch.full((size,), math.log(initial_scale)))
        self.target = (self.mean.detach().clone(), self.log_scale.detach().exp())
        self.loss = MPOLoss(size, config)
        self.policy_optimiser = torch.optim.Adam([self.mean, self.log_scale], rate)
        self.dual_optimiser = self.loss.duals.adam(3e-2)

    def run(self, steps, period=10, states=32, samples=20):
        history = []
        for step in range(steps):
            target_mean, target_scale = (t.expand(states, -1) for t in self.target)
            noise = torch.randn(samples, states, len(self.mean), generator=self.generator)
            action = target_mean + target_scale * noise
            online = (self.mean.expand(states, -1), self.log_scale.exp().expand(states, -1))
            loss, stats = self.loss(online, (target_mean, target_scale), action, self.value(action))
            self.policy_optimiser.zero_grad()
            self.dual_optimiser.zero_grad()
            loss.backward()
            self.policy_optimiser.step()
            self.dual_optimiser.step()
            history.append(scalars(stats._asdict()))
            if step % period == period - 1:
                self.target = (self.mean.detach().clone(), self.log_scale.detach().exp())
        return history


GOLDEN = MPOConfig(initial_temperature=1.0, initial_alpha_mean=1.0, initial_alpha_scale=1.0, epsilon_scale=1e-4)


def test_converges_to_the_optimum_of_a_quadratic_bandit():
    optimum = torch.tensor([0.6, -0.3])
    bandit = Bandit(lambda a: -10 * ((a - optimum) ** 2).sum(-1), config=GOLDEN)
    bandit.run(400)
    assert torch.allclose(bandit.mean, optimum, atol=0.05)
    assert bool((bandit.log_scale.exp() < 0.2).all())


def test_temperature_settles_where_the_e_step_meets_its_constraint():
    config = MPOConfig(initial_temperature=1.0, initial_alpha_mean=1.0)
    history = Bandit(lambda a: 3 * a.sum(-1), config=config).run(500)
    assert np.mean([h["mpo/kl_improvement"] for h in history[-100:]]) == pytest.approx(1.0, abs=0.15)


def test_mean_moves_at_the_speed_of_its_constraint():
    # On a slope that never ends, nothing but the constraint holds the mean back.
    config = MPOConfig(
        initial_temperature=1.0, initial_alpha_mean=20.0, epsilon_mean=1e-3, epsilon_penalty=0.0, epsilon_scale=1e-5
    )
    history = Bandit(lambda a: 30 * a.sum(-1), config=config, rate=2e-3).run(900, period=25)
    ends = [h["mpo/kl_mean"] for h in history[-250:]]
    assert np.mean(ends) == pytest.approx(1.0, abs=0.5)


def test_action_penalty_keeps_the_mean_near_the_box():
    free = Bandit(lambda a: 5 * a.sum(-1), config=MPOConfig(initial_temperature=1.0, initial_alpha_mean=1.0,
                                                            epsilon_penalty=0.0))
    bound = Bandit(lambda a: 5 * a.clamp(-1, 1).sum(-1), config=MPOConfig(
        initial_temperature=1.0, initial_alpha_mean=1.0, epsilon_penalty=0.1))
    free.run(300)
    bound.run(300)
    assert float(free.mean.detach().min()) > 1.2
    assert 0.6 < float(bound.mean.detach().mean()) < 1.2


def test_optimal_temperature_minimises_its_dual():
    q = torch.randn(500, 8, generator=torch.Generator().manual_seed(1))
    duals = Duals(temperature=1.0)
    optimiser = duals.adam(0.05)
    for _ in range(300):
        better = improve(q, torch.full_like(q, -math.log(500)), duals["temperature"], 0.1, dim=0)
        optimiser.zero_grad()
        better.temperature_loss.backward()
        optimiser.step()
    assert float(better.kl) == pytest.approx(1.0, rel=0.05)
    # For Q ~ N(0, 1) the reweighted distribution is N(1 / eta, 1), whose KL is 1 / (2 eta^2).
    assert duals["temperature"].item() == pytest.approx(math.sqrt(5), rel=0.1)


def test_kl_is_reported_for_each_dimension():
    online = torch.tensor([[0.1, 0.0]]), torch.tensor([[0.5, 1.0]])
    target = torch.tensor([[0.0, 0.0]]), torch.tensor([[0.5, 0.8]])
    _, stats = MPOLoss(2)(online, target, torch.randn(3, 1, 2), torch.randn(3, 1))
    logged = scalars(stats._asdict())
    # (0.1 / 0.5)^2 / 2 = 0.02, which is 8 times 0.0025.
    assert logged["mpo/kl_mean/0"] == pytest.approx(8.0) and logged["mpo/kl_mean/1"] == 0.0
    assert logged["mpo/kl_scale/0"] == 0.0 and logged["mpo/kl_scale/1"] > 1.0
    assert logged["mpo/kl_mean"] == pytest.approx(4.0)


def test_dual_variables_begin_where_they_are_told_and_stay_where_they_can_be_learned():
    duals = Duals(small=0.01, large=1000.0, each=torch.tensor([1.0, 10.0]))
    for name, value in (("small", [0.01]), ("large", [1000.0]), ("each", [1.0, 10.0])):
        assert duals[name].flatten().tolist() == pytest.approx(value, rel=1e-5)
    optimiser = duals.adam(100.0)
    for _ in range(30):
        optimiser.zero_grad()
        sum(duals[name].sum() for name in ("small", "large", "each")).backward()
        optimiser.step()
    assert all(p.min() >= -18.0 and (duals.raw[k].grad is not None) for k, p in duals.raw.items())
    assert all((duals[name] > 0).all() for name in duals.raw)


def test_only_actions_outside_the_box_cost():
    action = torch.tensor([[[0.5, -1.0]], [[1.5, 0.0]], [[-4.0, 5.0]]])
    assert action_cost(action).squeeze().tolist() == pytest.approx([0.0, -0.5, -5.0])


def test_targets_stop_where_the_return_ends():
    reward, value = torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([8.0])
    assert float(td_target(reward, torch.ones(1, 3), value, 0.5)) == pytest.approx(1 + 1 + 1 + 1)
    assert float(td_target(reward, torch.tensor([[1.0, 0.0, 1.0]]), value, 0.5)) == pytest.approx(2.0)


@pytest.mark.parametrize("field", ["epsilon", "epsilon_mean", "epsilon_scale"])
def test_impossible_constraints_are_refused(field):
    with pytest.raises(ValueError, match=field):
        MPOConfig(**{field: 0.0})
