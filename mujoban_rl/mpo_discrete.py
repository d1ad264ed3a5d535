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
from torch.nn import functional

_SMALLEST = 1e-8


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
        values = (self.epsilon, self.epsilon_policy, self.initial_temperature, self.initial_alpha)
        if min(values) <= 0:
            raise ValueError(f"{self}: expected every value above 0")


class DiscreteMPOStats(NamedTuple):
    """Scalars to log; the KLs are relative to their bounds, so that 1 means on constraint."""

    policy_loss: Tensor
    temperature: Tensor
    alpha: Tensor
    kl_improvement: Tensor
    kl_policy: Tensor
    entropy: Tensor


class DiscreteMPO(nn.Module):
    """Policy loss of discrete MPO; holds the dual variables, which want an optimiser of their own (about 1e-2)."""

    def __init__(self, config: DiscreteMPOConfig | None = None) -> None:
        super().__init__()
        self.config = config or DiscreteMPOConfig()
        self.log_temperature = nn.Parameter(_inverse_softplus(self.config.initial_temperature))
        self.log_alpha = nn.Parameter(_inverse_softplus(self.config.initial_alpha))

    @property
    def temperature(self) -> Tensor:
        """Dual variable eta > 0 of the E-step."""
        return functional.softplus(self.log_temperature) + _SMALLEST

    @property
    def alpha(self) -> Tensor:
        """Dual variable alpha > 0 of the M-step."""
        return functional.softplus(self.log_alpha) + _SMALLEST

    def forward(self, logits: Tensor, target_logits: Tensor, q: Tensor) -> tuple[Tensor, DiscreteMPOStats]:
        """Return the loss of policy and dual variables together, and what to log.

        Args:
            logits: Online policy, [B, A]; the only argument that gets a gradient.
            target_logits: Target policy, [B, A].
            q: Target critic, [B, A].
        """
        log_prior = functional.log_softmax(target_logits.detach(), 1)
        log_policy = functional.log_softmax(logits, 1)
        improved = improved_policy(q.detach(), log_prior, self.temperature.detach())
        temperature_loss = temperature_dual(q.detach(), log_prior, self.temperature, self.config.epsilon)
        cross_entropy = -(improved * log_policy).sum(1).mean()
        kl = kl_divergence(log_prior, log_policy).mean()
        trust_region = self.alpha.detach() * kl
        alpha_loss = self.alpha * (self.config.epsilon_policy - kl.detach())
        loss = cross_entropy + trust_region + alpha_loss + temperature_loss
        with torch.no_grad():
            kl_improvement = kl_divergence(improved.clamp(min=1e-30).log(), log_prior).mean()
            stats = DiscreteMPOStats(
                cross_entropy.detach(),
                self.temperature.detach(),
                self.alpha.detach(),
                kl_improvement / self.config.epsilon,
                kl.detach() / self.config.epsilon_policy,
                -(log_policy.exp() * log_policy).sum(1).mean(),
            )
        return loss, stats


def improved_policy(q: Tensor, log_prior: Tensor, temperature: Tensor) -> Tensor:
    """Return the exact E-step, softmax(Q / eta + log pi_target), [B, A]."""
    return functional.softmax(q / temperature + log_prior, 1)


def temperature_dual(q: Tensor, log_prior: Tensor, temperature: Tensor, epsilon: float) -> Tensor:
    """Return the dual g(eta) = eta epsilon + eta E log E_pi exp(Q / eta), a scalar to be minimised."""
    log_mean = torch.logsumexp(q / temperature + log_prior, 1)  # Shape [B]
    return temperature * (epsilon + log_mean.mean())


def kl_divergence(log_p: Tensor, log_q: Tensor) -> Tensor:
    """Return KL(p | q) of categorical distributions given by log-probabilities, [B] from [B, A]."""
    return (log_p.exp() * (log_p - log_q)).sum(1)


def expected_value(q: Tensor, logits: Tensor) -> Tensor:
    """Return E_pi Q(s, a), [B] from [B, A]."""
    return (q * functional.softmax(logits, 1)).sum(1)


def _inverse_softplus(value: float) -> Tensor:
    return torch.log(torch.expm1(torch.tensor(float(value), dtype=torch.float64))).float()
