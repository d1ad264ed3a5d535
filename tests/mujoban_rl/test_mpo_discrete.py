import math

import pytest
import torch

from mujoban_rl.losses.mpo import improve
from mujoban_rl.losses.mpo_discrete import DiscreteMPO, DiscreteMPOConfig, expected_value
from mujoban_rl.losses.returns import windowed_returns

# A walk on 6 cells with 5 actions (left, right, stay, stay, stay): +1 at the right end. gamma = 0.9.
STATES, ACTIONS, GAMMA = 6, 5, 0.9
NEXT = torch.tensor([[max(s - 1, 0), s + 1, s, s, s] for s in range(STATES - 1)])
REWARD = torch.where(NEXT == STATES - 1, 1.0, 0.0) - 0.01
CONTINUES = (NEXT != STATES - 1).float()


def _optimal_q():
    q = torch.zeros(STATES - 1, ACTIONS)
    for _ in range(300):
        value = torch.cat([q.max(1).values, torch.zeros(1)])
        q = REWARD + GAMMA * CONTINUES * value[NEXT]
    return q


def test_mpo_finds_the_known_optimal_policy_and_its_q_values():
    torch.manual_seed(0)
    logits, target = torch.zeros(STATES - 1, ACTIONS, requires_grad=True), torch.zeros(STATES - 1, ACTIONS)
    q = torch.zeros(STATES - 1, ACTIONS)
    mpo = DiscreteMPO(DiscreteMPOConfig(epsilon_policy=0.05))
    adam = torch.optim.Adam([{"params": [logits], "lr": 0.1}, {"params": mpo.parameters(), "lr": 0.1}])
    for step in range(800):
        value = torch.cat([expected_value(q, target), torch.zeros(1)])
        q = q + 0.3 * (REWARD + GAMMA * CONTINUES * value[NEXT] - q)
        loss, stats = mpo(logits, target, q)
        adam.zero_grad()
        loss.backward()
        adam.step()
        if step % 5 == 0:
            target = logits.detach().clone()
    optimal = _optimal_q()
    assert torch.equal(logits.argmax(1), optimal.argmax(1))
    assert (torch.softmax(logits, 1)[:, 1] > 0.95).all()
    assert torch.allclose(q[:, 1], optimal[:, 1], atol=0.03)
    assert stats.kl_policy < 3.0


def test_temperature_that_minimises_the_dual_puts_the_improved_policy_on_its_constraint():
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(64, ACTIONS, generator=generator)
    log_prior = torch.log_softmax(torch.randn(64, ACTIONS, generator=generator), 1)
    mpo = DiscreteMPO()
    adam = mpo.duals.adam(0.1)
    for _ in range(600):
        better = improve(q, log_prior, mpo.duals["temperature"], 0.1, dim=1)
        adam.zero_grad()
        better.temperature_loss.backward()
        adam.step()
    improved, prior = torch.distributions.Categorical(better.weights), torch.distributions.Categorical(logits=log_prior)
    assert torch.distributions.kl_divergence(improved, prior).mean().item() == pytest.approx(0.1, rel=0.02)
    assert better.kl.item() == pytest.approx(1.0, rel=0.02)


def test_improved_policy_is_the_closed_form():
    q, log_prior = torch.tensor([[1.0, 2.0, 0.0]]), torch.tensor([[0.5, 0.25, 0.25]]).log()
    weights = torch.tensor([0.5 * 2.718281828**0.5, 0.25 * 2.718281828**1.0, 0.25])
    improved = improve(q, log_prior, torch.tensor(2.0), 0.1, dim=1).weights[0]
    assert torch.allclose(improved, weights / weights.sum(), atol=1e-6)


def test_only_the_online_policy_and_the_dual_variables_are_trained():
    logits, target, q = (torch.randn(4, ACTIONS, requires_grad=True) for _ in range(3))
    mpo = DiscreteMPO()
    mpo(logits, target, q)[0].backward()
    assert logits.grad is not None and target.grad is None and q.grad is None
    assert all(variable.grad is not None for variable in mpo.duals.parameters())


def test_policies_whose_logits_are_far_apart_are_held_together_as_others_are():
    before = torch.tensor([[0.0, -50.0, -200.0], [0.0, 0.0, -float("inf")]])
    logits = torch.tensor([[0.0, -150.0, -200.0], [0.0, 1.0, -float("inf")]], requires_grad=True)
    loss, stats = DiscreteMPO()(logits, before, torch.zeros(2, 3))
    loss.backward()
    assert logits.grad is not None and logits.grad.isfinite().all()
    moved = math.log((1.0 + math.e) / 2.0) - 0.5  # of two equal actions, one became e times as probable
    assert stats.kl_policy.item() == pytest.approx(moved / 2.0 / DiscreteMPOConfig().epsilon_policy, rel=1e-4)


def test_contradictory_configuration_is_rejected():
    with pytest.raises(ValueError, match="above 0"):
        DiscreteMPOConfig(epsilon=0.0)


def test_returns_stop_at_the_end_of_an_episode_and_at_dropped_steps():
    reward = torch.tensor([[1.0, 2.0, 4.0]]).expand(4, 3)
    terminated, dropped = torch.zeros(2, 4, 3, dtype=torch.bool)
    terminated[1, 1] = True
    dropped[2, 2] = True
    dropped[3, 0] = True
    returns = windowed_returns(reward, terminated, dropped, 0.5)
    assert returns.reward.tolist() == [3.0, 2.0, 2.0, 0.0]
    assert returns.bootstrap.tolist() == [0.125, 0.0, 0.25, 1.0]
    assert returns.index.tolist()[::2] == [3, 2]
    assert returns.valid.tolist() == [True, True, True, False]
