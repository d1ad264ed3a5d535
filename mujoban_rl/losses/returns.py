"""n-step returns, the targets of critics.

Shapes: B states, n steps of a return.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


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


class Returns(NamedTuple):
    """n-step returns without their bootstrap."""

    reward: Tensor
    """Discounted rewards, [B]."""
    bootstrap: Tensor
    """Discount of the value of the state at `index`, 0 after a termination, [B]."""
    index: Tensor
    """Place in the window of the state to bootstrap from, [B]."""
    valid: Tensor
    """False where the first step itself was dropped, [B]."""


def windowed_returns(reward: Tensor, terminated: Tensor, dropped: Tensor, discount: float) -> Returns:
    """Return n-step returns of windows, cut at the end of an episode.

    Args:
        reward: [B, n].
        terminated: The episode ended in the step for good; no value after it, [B, n].
        dropped: The step does not count, and the episode ends before it (failure, time limit), [B, n].
        discount: Per step.
    """
    batch, n = reward.shape
    total, factor = torch.zeros_like(reward[:, 0]), torch.ones_like(reward[:, 0])
    index = torch.full((batch,), n, dtype=torch.int64, device=reward.device)
    going = torch.ones(batch, dtype=torch.bool, device=reward.device)
    for step in range(n):
        cut = going & dropped[:, step]
        index = torch.where(cut, step, index)
        going = going & ~cut
        total = total + torch.where(going, factor * reward[:, step], 0.0)
        factor = torch.where(going, factor * discount, factor)
        ended = going & terminated[:, step]
        factor = torch.where(ended, 0.0, factor)
        index = torch.where(ended, step, index)
        going = going & ~ended
    return Returns(total, factor, index, ~dropped[:, 0])
