"""PPO's loss and advantages: hand-computed cases, and a bandit learned from scratch."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal

from mujoban_rl.losses.ppo import PPOConfig, generalised_advantages, ppo_loss


def test_advantages_of_a_hand_computed_case():
    reward = torch.tensor([[1.0], [0.0], [2.0]])
    discount = torch.tensor([[0.9], [0.9], [0.9]])
    value = torch.tensor([[0.5], [1.0], [1.5]])
    advantage, target = generalised_advantages(reward, discount, value, torch.tensor([2.0]), 0.5)
    # Surprises: 1 + 0.9 * 1 - 0.5 = 1.4; 0.9 * 1.5 - 1 = 0.35; 2 + 0.9 * 2 - 1.5 = 2.3.
    expected = [1.4 + 0.45 * (0.35 + 0.45 * 2.3), 0.35 + 0.45 * 2.3, 2.3]
    assert advantage[:, 0].tolist() == pytest.approx(expected)
    assert target[:, 0].tolist() == pytest.approx([a + v for a, v in zip(expected, [0.5, 1.0, 1.5], strict=True)])


def test_nothing_flows_back_over_the_end_of_an_episode():
    reward, value = torch.tensor([[1.0], [5.0]]), torch.zeros(2, 1)
    discount = torch.tensor([[0.0], [0.9]])
    advantage, _ = generalised_advantages(reward, discount, value, torch.tensor([100.0]), 0.95)
    assert advantage[:, 0].tolist() == pytest.approx([1.0, 95.0])


def test_the_loss_of_a_hand_computed_case():
    old = torch.zeros(4)
    log_prob = torch.tensor([1.5, 1.5, 0.5, 0.5]).log().requires_grad_()
    advantage = torch.tensor([1.0, -1.0, 1.0, -1.0])
    value = torch.tensor([1.0, 0.0, 0.0, 0.0], requires_grad=True)
    loss, stats = ppo_loss(log_prob, old, advantage, value, torch.zeros(4), PPOConfig(clip=0.2, value_weight=0.5))
    # Gains are cut at 1.2 and 0.8, losses are not: 1.2, -1.5, 0.5, -0.8.
    assert float(stats["loss/policy"]) == pytest.approx(-(1.2 - 1.5 + 0.5 - 0.8) / 4)
    assert float(loss) == pytest.approx(0.15 + 0.5 * 0.25)
    assert float(stats["clipped"]) == 1.0
    kl = (2 * (0.5 - math.log(1.5)) + 2 * (-0.5 - math.log(0.5))) / 4
    assert float(stats["kl"]) == pytest.approx(kl)
    loss.backward()
    # No gradient where the gain is cut.
    assert (log_prob.grad != 0).tolist() == [False, True, True, False]


def test_a_bandit_is_learned():
    torch.manual_seed(0)
    mean = torch.zeros(1, requires_grad=True)
    adam = torch.optim.Adam([mean], 0.05)
    for _ in range(60):
        policy = Normal(mean.detach(), 0.3)
        action = policy.sample((256,))[:, 0]
        reward = -(action - 0.8).square()
        advantage = (reward - reward.mean()) / reward.std()
        for _ in range(2):
            log_prob = Normal(mean, 0.3).log_prob(action)
            loss, _ = ppo_loss(
                log_prob, policy.log_prob(action), advantage, torch.zeros(256), torch.zeros(256), PPOConfig()
            )
            adam.zero_grad()
            loss.backward()
            adam.step()
    assert float(mean.detach()) == pytest.approx(0.8, abs=0.1)


def test_a_clip_that_bounds_nothing_is_refused():
    with pytest.raises(ValueError, match=r"clip is 1\.5: expected a number between 0 and 1"):
        PPOConfig(clip=1.5)
