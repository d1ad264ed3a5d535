"""MPO for discrete actions (Abdolmaleki et al. 2018), the planner's reinforcement learning (paper C.2).

With few actions the E-step is exact: the improved policy q(a|s) is proportional to pi_target(a|s) exp(Q(s, a) / eta),
its temperature eta the minimiser of the dual, so that E KL(q | pi_target) <= epsilon. The M-step fits pi to q within a
trust region E KL(pi_target | pi) <= epsilon_policy, whose multiplier alpha is learned too.

Shapes: B states, A actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn import functional

from mujoban_core.ranges import check_positive
from mujoban_rl.losses.mpo import Duals, improve, trust_region


@dataclass(frozen=True)
class DiscreteMPOConfig:
    """Constraints of the two steps; the defaults are Acme's."""

    epsilon: float = 0.1
    """Bound on E KL(q | pi_target)."""
    epsilon_policy: float = 0.0025
    """Bound on E KL(pi_target | pi)."""
    initial_temperature: float = 10.0
    """eta at the start."""
    initial_alpha: float = 10.0
    """alpha at the start."""

    def __post_init__(self) -> None:
        """Reject constraints that cannot hold."""
        check_positive(self, *vars(self))


class DiscreteMPOStats(NamedTuple):
    """Scalars to log (`mpo.scalars`); the KLs are relative to their bounds."""

    policy_loss: Tensor
    temperature: Tensor
    alpha: Tensor
    kl_improvement: Tensor
    kl_policy: Tensor
    entropy: Tensor


class DiscreteMPO(nn.Module):
    """Policy loss of discrete MPO with its dual variables, whose optimiser is `duals.adam` (about 1e-2)."""

    def __init__(self, config: DiscreteMPOConfig | None = None) -> None:
        super().__init__()
        self.config = config or DiscreteMPOConfig()
        self.duals = Duals(temperature=self.config.initial_temperature, alpha=self.config.initial_alpha)

    def forward(self, logits: Tensor, target_logits: Tensor, q: Tensor) -> tuple[Tensor, DiscreteMPOStats]:
        """Return the loss of policy and dual variables together, and what to log.

        Args:
            logits: Online policy, [B, A]; the only argument that gets a gradient.
            target_logits: Target policy, [B, A].
            q: Target critic, [B, A].
        """
        config, duals = self.config, self.duals
        # What is not finite goes through, for the guard to see.
        prior = Categorical(logits=target_logits.detach(), validate_args=False)
        policy = Categorical(logits=logits, validate_args=False)
        better = improve(q, prior.logits, duals["temperature"], config.epsilon, dim=1)
        cross_entropy = -(better.weights * policy.logits).sum(1).mean()
        near = trust_region(_divergence(prior, policy), duals["alpha"], config.epsilon_policy)
        loss = cross_entropy + near.cost + near.dual_loss + better.temperature_loss
        stats = DiscreteMPOStats(
            cross_entropy, duals["temperature"], duals["alpha"], better.kl, near.kl, policy.entropy().mean()
        )
        return loss, DiscreteMPOStats._make(value.detach() for value in stats)


def _divergence(prior: Categorical, policy: Categorical) -> Tensor:
    """Return KL(prior | policy), [B], from logarithms.

    torch's is infinite where a probability of the policy is too small for a float32, however small that of the prior:
    a planner's logits are 100 apart and more.
    """
    terms = prior.probs * (prior.logits - policy.logits)
    return torch.where(prior.probs > 0.0, terms, 0.0).sum(1)


def expected_value(q: Tensor, logits: Tensor) -> Tensor:
    """Return E_pi Q(s, a), [B] from [B, A]."""
    return (q * functional.softmax(logits, 1)).sum(1)
