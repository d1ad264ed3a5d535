"""The planner as its learner has it: pushes are taught as well as instructions, verdicts stay what they were.

It plays by its push head and its verdicts before all. What is earned teaches the push head through the policy; what is
deadly is a fact, which the rewards of a few games would only blur, so that an anchor holds the verdicts while the trunk
that they read changes under them.

Shapes: B states, N = `grid.GRID_SIZE`, A = 5 instructions.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mujoban_planner.heads import PlannerOutput
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.push_policy import Anchor


class TaughtPlanner(nn.Module):
    """A planner whose answers carry its anchor: whatever loss they go into, that of the anchor is added to it."""

    def __init__(self, planner: LearnedPlanner, weight: float) -> None:
        """Teach `planner` in place; hold its verdicts to what they are now, by so much, 0 for not at all."""
        super().__init__()
        self.planner = planner
        self._anchor = Anchor(planner, weight, 1.0) if weight else None
        self.drift = 0.0
        """Loss of the anchor in the last answer that was learned from."""

    def forward(self, states: Tensor) -> PlannerOutput:
        """Return what the planner says of states, [B, N, N, 4] with values in [0, 1]."""
        output = self.planner(states, follow=False)
        if self._anchor is None or not torch.is_grad_enabled():
            return output
        loss = self._anchor.verdict_loss(output, states)
        self.drift = float(loss.detach())
        return output._replace(q=_Beside.apply(output.q, loss))


class _Beside(torch.autograd.Function):
    """Values as they are; where they get a gradient, a loss beside them gets its own.

    So it goes through the same step, clipping and guard as the loss that `DiscreteMPOLearner` makes of the values.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, loss: Tensor) -> Tensor:
        """Return the values, [B, A]."""
        del ctx, loss
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of values, [B, A], and loss, []."""
        del ctx
        (gradient,) = gradients
        return gradient, gradient.new_ones(())
