"""What continuous and discrete MPO share (Abdolmaleki et al. 2018): dual variables, E-step, trust region, statistics.

All KL statistics are relative to their bounds: 1 means on the constraint.

Shape legend: B states, D dimensions of the action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

_FLOOR: Final = 1e-8
"""Added to dual variables, which softplus may round to zero."""
_LOWEST: Final = -18.0
"""Raw value below which softplus has no gradient to speak of."""


class Duals(nn.Module):
    """Dual variables by name, kept positive by softplus; they want an optimiser of their own, `adam`."""

    def __init__(self, **initial: float | Tensor) -> None:
        """Start from these values, of any shape."""
        super().__init__()
        self.raw = nn.ParameterDict(
            {name: nn.Parameter(_inverse_softplus(torch.as_tensor(value))) for name, value in initial.items()}
        )

    def __getitem__(self, name: str) -> Tensor:
        """Return the value of a variable, above 0."""
        return functional.softplus(self.raw[name]) + _FLOOR

    def adam(self, rate: float) -> torch.optim.Adam:
        """Return an optimiser of the variables that keeps them where softplus has a gradient."""
        optimiser = torch.optim.Adam(self.parameters(), rate)
        optimiser.register_step_post_hook(lambda *_: self._limit())
        return optimiser

    @torch.no_grad()
    def _limit(self) -> None:
        for parameter in self.parameters():
            parameter.clamp_(min=_LOWEST)


class Improvement(NamedTuple):
    """The E-step: the policy that is better than the target policy, and as close to it as allowed."""

    weights: Tensor
    """Probabilities of the actions, without gradient; shape of Q."""
    temperature_loss: Tensor
    """Dual g(eta) = eta epsilon + eta E log E_pi exp(Q / eta), whose minimiser meets the constraint; scalar."""
    kl: Tensor
    """E KL to the target policy, relative to its bound; scalar."""


def improve(q: Tensor, log_prior: Tensor, temperature: Tensor, epsilon: float, dim: int) -> Improvement:
    """Solve the E-step: q(a|s) proportional to pi_target(a|s) exp(Q(s, a) / eta).

    Args:
        q: Values of actions, which lie along `dim`.
        log_prior: Log-probability of each of them under the target policy, or -log N of each of N samples of it.
        temperature: Dual variable eta, scalar.
        epsilon: Bound on the KL to the target policy.
        dim: Axis of the actions.
    """
    tempered = q.detach() / temperature + log_prior.detach()
    weights = torch.softmax(tempered, dim).detach()
    loss = temperature * (epsilon + torch.logsumexp(tempered, dim).mean())
    kl = (torch.xlogy(weights, weights) - weights * log_prior.detach()).sum(dim).mean()
    return Improvement(weights, loss, kl / epsilon)


class TrustRegion(NamedTuple):
    """A bound on the KL from the target policy to the one that learns."""

    cost: Tensor
    """Loss of the policy, scalar."""
    dual_loss: Tensor
    """Loss of the multipliers, scalar."""
    kl: Tensor
    """Mean over states, relative to the bound; as many dimensions as are bound by themselves, [D] or a scalar."""


def trust_region(kl: Tensor, alpha: Tensor, epsilon: float) -> TrustRegion:
    """Return the losses of a bound on the mean KL over states.

    Args:
        kl: Divergence per state, [B] or [B, D].
        alpha: Multipliers, scalar or [D].
        epsilon: Bound, for each dimension.
    """
    mean = kl.mean(0)
    return TrustRegion(
        (alpha.detach() * mean).sum(), (alpha * (epsilon - mean.detach())).sum(), mean.detach() / epsilon
    )


def scalars(statistics: Mapping[str, Tensor], prefix: str = "mpo") -> dict[str, float]:
    """Return statistics to log; those with a value per dimension also one by one."""
    named: dict[str, float] = {}
    for name, value in statistics.items():
        named[f"{prefix}/{name}"] = float(value.mean())
        if value.dim():
            named |= {f"{prefix}/{name}/{i}": float(v) for i, v in enumerate(value)}
    return named


def _inverse_softplus(value: Tensor) -> Tensor:
    exact = value.to(torch.float64)
    return (exact + torch.log(-torch.expm1(-exact))).float()
