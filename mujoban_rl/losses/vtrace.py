"""V-trace, the off-policy corrected actor-critic (Espeholt et al. 2018), which the paper's baselines learn by (D.2).

Shape legend: T steps, B trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from mujoban_core.ranges import check_not_negative, check_positive


@dataclass(frozen=True)
class VTraceConfig:
    """Truncation of importance weights, by default as in IMPALA, and weights of the loss's terms."""

    clip_rho: float = 1.0
    """Bound of the weights in the temporal differences: which policy the values are of."""
    clip_c: float = 1.0
    """Bound of the weights that carry differences back in time: how fast they arrive."""
    value_weight: float = 0.5
    """Weight of the squared errors of values."""
    entropy_weight: float = 1e-3
    """Weight of the bonus for entropy."""

    def __post_init__(self) -> None:
        """Reject bounds with which nothing is learned."""
        check_positive(self, "clip_rho", "clip_c")
        check_not_negative(self, "value_weight", "entropy_weight")
        if self.clip_c > self.clip_rho:
            raise ValueError(f"clip_c {self.clip_c} above clip_rho {self.clip_rho}: expected at most that")


class VTraceTargets(NamedTuple):
    """What policy and value function learn; without gradient."""

    value: Tensor
    """v_s, targets of the value function, [T, B]."""
    advantage: Tensor
    """Weights of the policy gradient, importance weight included, [T, B]."""


class VTraceStats(NamedTuple):
    """Scalars to log."""

    policy_loss: Tensor
    value_loss: Tensor
    entropy: Tensor
    rho: Tensor
    """Mean importance weight before truncation; 1 on policy."""


@torch.no_grad()
def vtrace_targets(
    log_rho: Tensor, reward: Tensor, discount: Tensor, value: Tensor, bootstrap: Tensor, config: VTraceConfig
) -> VTraceTargets:
    """Return targets and advantages of equation 1 and section 4.2 there.

    Args:
        log_rho: log pi(a|x) - log mu(a|x) of the actions taken, [T, B].
        reward: [T, B].
        discount: gamma, or 0 where an episode ended for good with the step, [T, B].
        value: V(x), [T, B].
        bootstrap: V of the state after the last step, [B].
        config: Truncation.
    """
    rho = log_rho.exp()
    clipped, trace = rho.clamp(max=config.clip_rho), rho.clamp(max=config.clip_c)
    following = torch.cat([value[1:], bootstrap[None]])
    delta = clipped * (reward + discount * following - value)
    correction = torch.zeros_like(bootstrap)
    corrections = torch.empty_like(value)
    for t in reversed(range(len(reward))):
        correction = delta[t] + discount[t] * trace[t] * correction
        corrections[t] = correction
    target = value + corrections
    next_target = torch.cat([target[1:], bootstrap[None]])
    return VTraceTargets(target, clipped * (reward + discount * next_target - value))


def vtrace_loss(
    log_prob: Tensor,
    behaviour_log_prob: Tensor,
    entropy: Tensor,
    value: Tensor,
    bootstrap: Tensor,
    reward: Tensor,
    discount: Tensor,
    config: VTraceConfig | None = None,
) -> tuple[Tensor, VTraceStats]:
    """Return the loss of policy and value function together, a scalar, and what to log.

    Args:
        log_prob: log pi(a|x) of the actions taken, [T, B].
        behaviour_log_prob: log mu(a|x) under the policy that took them, [T, B].
        entropy: Of pi in each state, [T, B].
        value: V(x), [T, B].
        bootstrap: V of the state after the last step, [B].
        reward: [T, B].
        discount: As in `vtrace_targets`, [T, B].
        config: Truncation and weights.
    """
    config = config or VTraceConfig()
    log_rho = log_prob.detach() - behaviour_log_prob
    targets = vtrace_targets(log_rho, reward, discount, value.detach(), bootstrap.detach(), config)
    policy_loss = -(targets.advantage * log_prob).mean()
    value_loss = functional.mse_loss(value, targets.value)
    loss = policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy.mean()
    stats = VTraceStats(policy_loss.detach(), value_loss.detach(), entropy.mean().detach(), log_rho.exp().mean())
    return loss, stats
