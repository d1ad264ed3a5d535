"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantages (Schulman et al. 2016).

Shape legend: T steps, B environments, M samples of a minibatch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mujoban_core.ranges import check_not_negative


@dataclass(frozen=True)
class PPOConfig:
    """Weights and bounds of the loss."""

    clip: float = 0.2
    """Largest relative change of an action's probability that is still rewarded."""
    value_weight: float = 0.5
    """Weight of the squared errors of values."""

    def __post_init__(self) -> None:
        """Reject bounds that bound nothing."""
        check_not_negative(self, "value_weight")
        if not 0.0 < self.clip < 1.0:
            raise ValueError(f"clip is {self.clip}: expected a number between 0 and 1")


def generalised_advantages(
    reward: Tensor, discount: Tensor, value: Tensor, last_value: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """Return advantages and the value targets that go with them, [T, B] each.

    Args:
        reward: Of each step, [T, B].
        discount: Of what follows each step: gamma, or 0 where nothing does, [T, B].
        value: Of the state before each step, [T, B].
        last_value: Of the state after the last step, [B].
        decay: lambda.
    """
    advantage, carried = torch.zeros_like(reward), torch.zeros_like(last_value)
    following = last_value
    for t in reversed(range(len(reward))):
        surprise = reward[t] + discount[t] * following - value[t]
        carried = surprise + discount[t] * decay * carried
        advantage[t], following = carried, value[t]
    return advantage, advantage + value


def ppo_loss(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, value: Tensor, target: Tensor, config: PPOConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the clipped surrogate with the squared error of the values, and statistics.

    Args:
        log_prob: Of the actions taken, under the policy that learns, [M].
        old_log_prob: Under the policy that acted, [M].
        advantage: Of the actions, normalised, [M].
        value: Predicted, [M].
        target: What it should be, [M].
        config: Weights and bounds.
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
    policy = -torch.min(ratio * advantage, clipped * advantage).mean()
    error = (value - target).square().mean()
    # The estimator of KL(old || new) with the smaller variance.
    kl = (ratio.detach() - 1.0 - log_ratio.detach()).mean()
    stats = {
        "loss/policy": policy.detach(),
        "loss/value": error.detach(),
        "kl": kl,
        "clipped": ((ratio.detach() - 1.0).abs() > config.clip).float().mean(),
    }
    return policy + config.value_weight * error, stats
