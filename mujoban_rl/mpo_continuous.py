"""Maximum a posteriori policy optimisation with Gaussian policies (Abdolmaleki et al. 2018a, 2018b).

After Acme's `MPO` loss: the E-step reweights actions sampled from the target policy by exp(Q / temperature); the
M-step fits the online policy to them under KL constraints that are decoupled into mean and scale and hold for
each action dimension. Temperature and multipliers are dual variables, learned through softplus.

All KL statistics are relative to their epsilon: 1 means on the constraint.

Shape legend: N sampled actions, B states, D action dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn
from torch.nn import functional

_FLOOR = 1e-8
"""Added to dual variables, which softplus may round to zero."""
_MIN_LOG_DUAL = -18.0


@dataclass(frozen=True)
class MPOConfig:
    """Constraints and initial dual variables; the latter before softplus, as in Acme."""

    epsilon: float = 0.1
    """Constraint on the KL between the reweighted and the target policy."""
    epsilon_mean: float = 0.0025
    """Constraint on the KL of the mean, per dimension."""
    epsilon_scale: float = 1e-6
    """Constraint on the KL of the scale, per dimension."""
    epsilon_penalty: float = 0.001
    """Constraint of the E-step which keeps actions in [-1, 1]; 0 leaves it out."""
    initial_temperature: float = 10.0
    initial_alpha_mean: float = 10.0
    initial_alpha_scale: float = 1000.0
    dual_learning_rate: float = 1e-2

    def __post_init__(self) -> None:
        """Reject constraints that cannot hold."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not (value > 0 or (item.name == "epsilon_penalty" and value == 0)):
                raise ValueError(f"{item.name} is {value}: expected a positive number")


def weights_and_temperature_loss(q: Tensor, epsilon: float, temperature: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the E-step.

    Args:
        q: Values of sampled actions, [N, B].
        epsilon: Constraint on the KL to the target policy.
        temperature: Dual variable, scalar.

    Returns:
        Normalised weights without gradient, [N, B], and the loss of the temperature.
    """
    tempered = q.detach() / temperature
    weights = torch.softmax(tempered, dim=0).detach()
    log_mean = torch.logsumexp(tempered, dim=0) - math.log(len(q))
    return weights, temperature * (epsilon + log_mean.mean())


def nonparametric_kl(weights: Tensor) -> Tensor:
    """Return the KL of normalised weights, [N, B], to uniform ones, [B]."""
    return (weights * torch.log(len(weights) * weights + _FLOOR)).sum(0)


def gaussian_log_prob(action: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return log densities of actions [N, B, D] under mean and scale [B, D], summed over D, [N, B]."""
    per_dimension = -0.5 * ((action - mean) / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)
    return per_dimension.sum(-1)


def gaussian_kl(mean_p: Tensor, scale_p: Tensor, mean_q: Tensor, scale_q: Tensor) -> Tensor:
    """Return KL(p || q) of normal distributions for each dimension, [B, D]."""
    variance_ratio = (scale_p / scale_q) ** 2
    return 0.5 * (variance_ratio + ((mean_p - mean_q) / scale_q) ** 2 - 1.0 - variance_ratio.log())


def constraint_losses(kl: Tensor, alpha: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """Return the loss of the policy and of the multipliers for a constraint.

    Args:
        kl: Divergence per state and dimension, [B, D].
        alpha: Multipliers, [D].
        epsilon: Bound on the mean over states, for each dimension.
    """
    # Shape [D].
    mean = kl.mean(0)
    return (alpha.detach() * mean).sum(), (alpha * (epsilon - mean.detach())).sum()


def action_cost(action: Tensor) -> Tensor:
    """Return minus the distance of actions [N, B, D] from the box [-1, 1]^D, [N, B]."""
    return -(action - action.clamp(-1.0, 1.0)).norm(dim=-1)


def td_target(reward: Tensor, discount: Tensor, value: Tensor, gamma: float) -> Tensor:
    """Return n-step targets of Q, [B].

    Args:
        reward: Rewards of the next n steps, [B, n].
        discount: 0 where the return ends with that step, else 1, [B, n].
        value: Expected Q under the target policy after n steps, [B].
        gamma: Discount factor of one step.
    """
    total = value
    for k in reversed(range(reward.shape[1])):
        total = reward[:, k] + gamma * discount[:, k] * total
    return total


class MPOLoss(nn.Module):
    """MPO loss with its dual variables.

    The variables are parameters of this module: give them an optimiser of their own with
    `config.dual_learning_rate`, and call `limit_duals` after every step.
    """

    def __init__(self, action_size: int, config: MPOConfig | None = None) -> None:
        """Make the dual variables of a policy over `action_size` dimensions.

        Raises:
            ValueError: If there are no dimensions.
        """
        if action_size < 1:
            raise ValueError(f"action_size is {action_size}: expected at least 1")
        super().__init__()
        self.config = config = config or MPOConfig()
        self.log_temperature = nn.Parameter(torch.tensor(config.initial_temperature))
        self.log_penalty_temperature = nn.Parameter(torch.tensor(config.initial_temperature))
        self.log_alpha_mean = nn.Parameter(torch.full((action_size,), config.initial_alpha_mean))
        self.log_alpha_scale = nn.Parameter(torch.full((action_size,), config.initial_alpha_scale))

    @torch.no_grad()
    def limit_duals(self) -> None:
        """Keep dual variables where softplus has a gradient."""
        for parameter in self.parameters():
            parameter.clamp_(min=_MIN_LOG_DUAL)

    def forward(
        self,
        online: tuple[Tensor, Tensor],
        target: tuple[Tensor, Tensor],
        action: Tensor,
        q: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss and statistics.

        Args:
            online: Mean and scale of the policy that learns, [B, D] each.
            target: Mean and scale of the target policy, [B, D] each.
            action: Samples of the target policy, not limited to [-1, 1], [N, B, D].
            q: Their values under the target critic, [N, B].
        """
        config = self.config
        mean, scale = online
        target_mean, target_scale = (t.detach() for t in target)
        temperature = functional.softplus(self.log_temperature) + _FLOOR
        weights, temperature_loss = weights_and_temperature_loss(q, config.epsilon, temperature)
        stats = {"kl_q_relative": nonparametric_kl(weights).mean() / config.epsilon, "temperature": temperature}
        if config.epsilon_penalty > 0:
            extra, extra_loss, penalty_kl = self._penalty(action)
            weights, temperature_loss = weights + extra, temperature_loss + extra_loss
            stats["kl_penalty_relative"] = penalty_kl / config.epsilon_penalty
        # Decoupled M-step: the mean learns under the target's scale, the scale under the target's mean.
        policy_loss = -(weights * gaussian_log_prob(action, mean, target_scale)).sum(0).mean()
        policy_loss = policy_loss - (weights * gaussian_log_prob(action, target_mean, scale)).sum(0).mean()
        kl_mean = gaussian_kl(target_mean, target_scale, mean, target_scale)
        kl_scale = gaussian_kl(target_mean, target_scale, target_mean, scale)
        alpha_mean = functional.softplus(self.log_alpha_mean) + _FLOOR
        alpha_scale = functional.softplus(self.log_alpha_scale) + _FLOOR
        cost_mean, dual_mean = constraint_losses(kl_mean, alpha_mean, config.epsilon_mean)
        cost_scale, dual_scale = constraint_losses(kl_scale, alpha_scale, config.epsilon_scale)
        loss = policy_loss + cost_mean + cost_scale + dual_mean + dual_scale + temperature_loss
        stats |= {
            "loss": loss,
            "kl_mean_relative": kl_mean.mean() / config.epsilon_mean,
            "kl_scale_relative": kl_scale.mean() / config.epsilon_scale,
            "alpha_mean": alpha_mean.mean(),
            "alpha_scale": alpha_scale.mean(),
            "scale": scale.mean(),
            "q": q.mean(),
        }
        return loss, {k: v.detach() for k, v in stats.items()}

    def _penalty(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weights, temperature loss and KL of the E-step that keeps actions in the box."""
        temperature = functional.softplus(self.log_penalty_temperature) + _FLOOR
        weights, loss = weights_and_temperature_loss(action_cost(action), self.config.epsilon_penalty, temperature)
        return weights, loss, nonparametric_kl(weights).mean()
