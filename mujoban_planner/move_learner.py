"""The learner of MPO over moves: pushes may be taught as well as instructions, verdicts stay what they were.

A planner plays by its push head and its verdicts before all. What is earned teaches the push head through the policy;
what is deadly is a fact, which the rewards of a few games would only blur, so that an anchor holds the verdicts while
the trunk that they read changes under them.

Shapes: B states, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mujoban_planner.discrete_mpo import Answer, DiscreteMPOLearner, MPOBatch, MPOSettings
from mujoban_planner.heads import PlannerOutput
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.push_policy import Anchor
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import step_if_finite


class MoveLearner(DiscreteMPOLearner):
    """Teaches a planner by what its instructions earned."""

    network: LearnedPlanner
    target: LearnedPlanner

    def __init__(
        self,
        config: MPOSettings,
        planner: LearnedPlanner,
        device: torch.device | str = "cpu",
        *,
        teach_pushes: bool,
        anchor: float,
        critic_first: int = 0,
    ) -> None:
        """Teach `planner` in place.

        Args:
            config: What defines replay and learning.
            planner: What learns.
            device: Where.
            teach_pushes: Whether the push head learns too; otherwise the policy only follows it.
            anchor: How much it counts that its verdicts go on saying what they say now; 0 for not at all.
            critic_first: Updates in which the critic's head learns alone, and all else stays as it is.
        """
        super().__init__(config, planner, device)
        self._teach_pushes, self._critic_first = teach_pushes, critic_first
        self._anchor = Anchor(planner, anchor, 1.0) if anchor else None

    def update(self, batch: MPOBatch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step, at first of the critic's head alone.

        Nothing else would hold the policy: a loss that does so has no gradient before the policy has moved, and Adam's
        first steps along the critic's are as long as any.
        """
        if self._updates >= self._critic_first:
            return super().update(batch, progress, guard)
        batch = batch.to(self.device)
        loss = self.weigh(batch)[-1]
        head = list(self.network.heads.q.parameters())
        self._adam.zero_grad(set_to_none=True)
        loss.backward(inputs=head)
        self.count(step_if_finite(loss, [self._adam], guard, clipped=head) is not None)
        return {"q_loss": loss.item(), "mean_reward": batch.reward.mean().item()}

    def answers(self, network: nn.Module, states: Tensor) -> PlannerOutput:
        """Return what a planner says of states, [B, N, N, 4] with values in [0, 1]."""
        return network(states, follow=not self._teach_pushes)

    def further_losses(self, answer: Answer, states: Tensor) -> Mapping[str, Tensor]:
        """Return how far the verdicts have drifted."""
        assert isinstance(answer, PlannerOutput)
        return {} if self._anchor is None else {"drift": self._anchor.verdict_loss(answer, states)}
