import math

import pytest
import torch
from torch import nn

from mujoban_rl.losses.vtrace import VTraceConfig, vtrace_loss, vtrace_targets


def column(*values):
    return torch.tensor(values)[:, None]


def test_targets_equal_a_case_computed_by_hand():
    # Two steps, gamma 0.9, V = (1, 2), bootstrap 3, rewards (1, 0), importance weights 2 and 0.5.
    targets = vtrace_targets(
        column(math.log(2.0), math.log(0.5)), column(1.0, 0.0), column(0.9, 0.9), column(1.0, 2.0),
        torch.tensor([3.0]), VTraceConfig(),
    )  # fmt: skip
    # delta_1 = 0.5 (0 + 2.7 - 2) = 0.35, delta_0 = 1 (1 + 1.8 - 1) = 1.8
    # v_1 = 2.35, v_0 = 1 + 1.8 + 0.9 * 1 * 0.35 = 3.115; advantages 1 + 0.9 * 2.35 - 1 and 0.5 * 0.7
    assert targets.value[:, 0].tolist() == pytest.approx([3.115, 2.35])
    assert targets.advantage[:, 0].tolist() == pytest.approx([2.115, 0.35])


# Three steps with weights rho, gamma 0.9: what comes back from step 2 to step 1 is cut at 1, at step 0 halved.
RHO, REWARD, VALUE, BOOTSTRAP = column(0.5, 2.0, 1.0), column(1.0, 0.0, 2.0), column(1.0, 2.0, 0.0), torch.tensor([3.0])
LOOSE = VTraceConfig(clip_rho=2.0, clip_c=1.0, value_weight=0.5, entropy_weight=0.1)


def test_differences_come_back_in_time_by_the_product_of_weights():
    targets = vtrace_targets(RHO.log(), REWARD, column(0.9, 0.9, 0.9), VALUE, BOOTSTRAP, LOOSE)
    # delta_2 = 2 + 2.7 - 0 = 4.7, delta_1 = 2 (0 + 0 - 2) = -4, delta_0 = 0.5 (1 + 1.8 - 1) = 0.9; c = (0.5, 1, 1)
    # v_2 = 4.7, v_1 = 2 - 4 + 0.9 * 1 * 4.7 = 2.23, v_0 = 1 + 0.9 + 0.9 * 0.5 * 0.23 = 2.0035
    assert targets.value[:, 0].tolist() == pytest.approx([2.0035, 2.23, 4.7])
    # 0.5 (1 + 0.9 * 2.23 - 1), 2 (0 + 0.9 * 4.7 - 2), 2 + 0.9 * 3 - 0
    assert targets.advantage[:, 0].tolist() == pytest.approx([1.0035, 4.46, 4.7])


def test_loss_and_gradients_equal_a_case_computed_by_hand():
    log_prob, value, entropy, bootstrap = (
        x.clone().requires_grad_() for x in (RHO.log(), VALUE, column(1.0, 2.0, 3.0), BOOTSTRAP)
    )
    nothing = torch.zeros(3, 1)
    loss, stats = vtrace_loss(log_prob, nothing, entropy, value, bootstrap, REWARD, column(0.9, 0.9, 0.9), LOOSE)
    loss.backward()
    # log pi = (-ln 2, ln 2, 0); errors of the values (-1.0035, -0.23, -4.7)
    assert stats.policy_loss.item() == pytest.approx(-(4.46 - 1.0035) * math.log(2.0) / 3)
    assert stats.value_loss.item() == pytest.approx((1.00701225 + 0.0529 + 22.09) / 3)
    assert loss.item() == pytest.approx(-0.798620 + 0.5 * 7.716637 - 0.1 * 2.0, abs=1e-5)
    assert log_prob.grad[:, 0].tolist() == pytest.approx([-0.3345, -4.46 / 3, -4.7 / 3])
    assert value.grad[:, 0].tolist() == pytest.approx([-0.3345, -0.23 / 3, -4.7 / 3], abs=1e-6)
    assert entropy.grad[:, 0].tolist() == pytest.approx([-0.1 / 3] * 3)
    assert bootstrap.grad is None, "what is learned towards is held"


def test_on_policy_targets_are_discounted_returns_that_stop_at_an_episodes_end():
    reward, discount = column(1.0, 2.0, 4.0), column(0.5, 0.0, 0.5)
    nothing, last = torch.zeros(3, 1), torch.tensor([8.0])
    targets = vtrace_targets(nothing, reward, discount, nothing, last, VTraceConfig())
    assert targets.value[:, 0].tolist() == pytest.approx([1.0 + 0.5 * 2.0, 2.0, 4.0 + 0.5 * 8.0])


def test_weights_are_truncated():
    targets = vtrace_targets(
        column(5.0), column(1.0), column(0.0), column(0.0), torch.zeros(1), VTraceConfig(clip_rho=2.0, clip_c=1.0)
    )
    assert targets.value.item() == pytest.approx(2.0)
    with pytest.raises(ValueError, match=r"clip_c 2\.0 above clip_rho 1\.0"):
        VTraceConfig(clip_rho=1.0, clip_c=2.0)


def test_it_learns_a_corridor_from_scratch():
    """Five cells, the reward at the right end: found by trajectories that lag ten updates behind."""
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(1)
    net = nn.Linear(5, 3)
    nn.init.zeros_(net.weight)
    adam = torch.optim.Adam(net.parameters(), 0.05)
    behaviour = nn.Linear(5, 3)

    def play(batch=32, steps=20):
        cell, trajectory = torch.zeros(batch, dtype=torch.int64), []
        for _ in range(steps):
            state = torch.eye(5)[cell]
            policy = torch.distributions.Categorical(logits=behaviour(state)[:, :2])
            right = torch.multinomial(policy.probs, 1, generator=generator)[:, 0]
            after = (cell + 2 * right - 1).clamp(0, 4)
            done = after == 4
            trajectory.append((state, right, policy.log_prob(right), done.float(), 0.9 * (~done).float()))
            cell = torch.where(done, 0, after)
        return [torch.stack(x) for x in zip(*trajectory, strict=True)], torch.eye(5)[cell]

    for update in range(150):
        if update % 10 == 0:
            behaviour.load_state_dict(net.state_dict())
        with torch.no_grad():
            (state, action, log_mu, reward, discount), last = play()
        output = net(state)
        policy = torch.distributions.Categorical(logits=output[..., :2])
        log_pi, value, bootstrap = policy.log_prob(action), output[..., 2], net(last)[:, 2].detach()
        loss, _ = vtrace_loss(log_pi, log_mu, policy.entropy(), value, bootstrap, reward, discount)
        adam.zero_grad()
        loss.backward()
        adam.step()
    right = net(torch.eye(5)[:4])[:, :2].softmax(-1)[:, 1]
    assert right.min() > 0.9
    assert net(torch.eye(5)[3:4])[0, 2].item() == pytest.approx(1.0, abs=0.25)
