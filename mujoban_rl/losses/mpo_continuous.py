"""Maximum a posteriori policy optimisation with Gaussian policies (Abdolmaleki et al. 2018a, 2018b).

After Acme's `MPO` loss: the E-step reweights actions sampled from the target policy by exp(Q / temperature); the
M-step fits the online policy to them under KL constraints that are decoupled into mean and scale and hold for
each action dimension. Temperature and multipliers are dual variables.

Shape legend: N sampled actions, B states, D action dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from mujoban_core.ranges import check_not_negative, check_positive
from mujoban_rl.losses.mpo import Duals, Improvement, improve, trust_region


@dataclass(frozen=True)
class MPOConfig:
    """Constraints, and dual variables at the start; the defaults are Acme's."""

    epsilon: float = 0.1
    """Constraint on the KL between the reweighted and the target policy."""
    epsilon_mean: float = 0.0025
    """Constraint on the KL of the mean, per dimension."""
    epsilon_scale: float = 1e-6
    """Constraint on the KL of the scale, per dimension."""
    epsilon_penalty: float = 0.001
    """Constraint of the E-step which keeps actions in [-1, 1]; 0 leaves it out."""
    initial_temperature: float = 10.0
    """Temperature of the E-step at the start."""
    initial_alpha_mean: float = 10.0
    """Multiplier of the constraint on the mean at the start."""
    initial_alpha_scale: float = 1000.0
    """Multiplier of the constraint on the scale at the start."""
    dual_learning_rate: float = 1e-2
    """Learning rate of temperatures and multipliers."""

    def __post_init__(self) -> None:
        """Reject constraints that cannot hold."""
        check_not_negative(self, "epsilon_penalty")
        check_positive(self, *(name for name in vars(self) if name != "epsilon_penalty"))


class MPOStats(NamedTuple):
    """What to log (`mpo.scalars`); scalars but for the KLs of mean and scale. KLs are relative to their bounds."""

    loss: Tensor
    policy_loss: Tensor
    temperature: Tensor
    kl_improvement: Tensor
    kl_penalty: Tensor
    """Of the E-step that keeps actions in the box; 0 where it is left out."""
    kl_mean: Tensor
    """[D]."""
    kl_scale: Tensor
    """[D]."""
    alpha_mean: Tensor
    alpha_scale: Tensor
    scale: Tensor
    q: Tensor


def check_samples(samples: int) -> None:
    """Reject a number of sampled actions that makes no pairs.

    Raises:
        ValueError: If it is odd.
    """
    if samples < 2 or samples % 2:
        raise ValueError(f"samples is {samples}: expected an even number from 2 on")


def paired_noise(samples: int, like: Tensor, generator: torch.Generator) -> Tensor:
    """Return N = `samples` draws of noise, each with its opposite, [N, ...]: where values are alike the mean stays.

    The generator may be on the CPU wherever `like` is, so that a run draws the same on every device.
    """
    half = torch.randn((samples // 2, *like.shape), generator=generator, device=generator.device).to(like.device)
    return torch.cat([half, -half])


def action_cost(action: Tensor) -> Tensor:
    """Return minus the distance of actions [N, B, D] from the box [-1, 1]^D, [N, B]."""
    return -(action - action.clamp(-1.0, 1.0)).norm(dim=-1)


class MPOLoss(nn.Module):
    """MPO loss with its dual variables, whose optimiser is `duals.adam(config.dual_learning_rate)`."""

    def __init__(self, action_size: int, config: MPOConfig | None = None) -> None:
        """Make the dual variables of a policy over `action_size` dimensions.

        Raises:
            ValueError: If there are no dimensions.
        """
        if action_size < 1:
            raise ValueError(f"action_size is {action_size}: expected at least 1")
        super().__init__()
        self.config = config = config or MPOConfig()
        self.duals = Duals(
            temperature=config.initial_temperature,
            penalty_temperature=config.initial_temperature,
            alpha_mean=torch.full((action_size,), config.initial_alpha_mean),
            alpha_scale=torch.full((action_size,), config.initial_alpha_scale),
        )

    def forward(
        self,
        online: tuple[Tensor, Tensor],
        target: tuple[Tensor, Tensor],
        action: Tensor,
        q: Tensor,
    ) -> tuple[Tensor, MPOStats]:
        """Return the loss of policy and dual variables together, and what to log.

        Args:
            online: Mean and scale of the policy that learns, [B, D] each.
            target: Mean and scale of the target policy, [B, D] each.
            action: Samples of the target policy, not limited to [-1, 1], [N, B, D].
            q: Their values under the target critic, [N, B].
        """
        config, duals = self.config, self.duals
        mean, scale = online
        target_mean, target_scale = (t.detach() for t in target)
        better = _reweight(q, duals["temperature"], config.epsilon)
        weights, loss, kl_penalty = better.weights, better.temperature_loss, torch.zeros(())
        if config.epsilon_penalty > 0:
            inside = _reweight(action_cost(action), duals["penalty_temperature"], config.epsilon_penalty)
            weights, loss, kl_penalty = weights + inside.weights, loss + inside.temperature_loss, inside.kl
        # Decoupled M-step: the mean learns under the target's scale, the scale under the target's mean.
        before = _normal(target_mean, target_scale)
        moved, widened = _normal(mean, target_scale), _normal(target_mean, scale)
        likelihood = moved.log_prob(action).sum(-1) + widened.log_prob(action).sum(-1)
        policy_loss = -(weights * likelihood).sum(0).mean()
        at_mean = trust_region(kl_divergence(before, moved), duals["alpha_mean"], config.epsilon_mean)
        at_scale = trust_region(kl_divergence(before, widened), duals["alpha_scale"], config.epsilon_scale)
        loss = loss + policy_loss + at_mean.cost + at_scale.cost + at_mean.dual_loss + at_scale.dual_loss
        stats = MPOStats(
            loss, policy_loss, duals["temperature"], better.kl, kl_penalty, at_mean.kl, at_scale.kl,
            duals["alpha_mean"].mean(), duals["alpha_scale"].mean(), scale.mean(), q.mean(),
        )  # fmt: skip
        return loss, MPOStats._make(value.detach() for value in stats)


def _reweight(q: Tensor, temperature: Tensor, epsilon: float) -> Improvement:
    """Solve the E-step over samples of the target policy, of which one is as likely as another, [N, B]."""
    return improve(q, torch.full_like(q, -math.log(len(q))), temperature, epsilon, dim=0)


def _normal(mean: Tensor, scale: Tensor) -> Normal:
    """Return the distribution; what is not finite goes through, for the guard to see."""
    return Normal(mean, scale, validate_args=False)
