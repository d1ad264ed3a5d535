"""The planner's learner: pushes are taught as well as instructions, verdicts stay what they were.

A planner plays by its push head and its verdicts before all. What is earned teaches the push head through the policy;
what is deadly is a fact, which the rewards of a few games would only blur, so that an anchor holds the verdicts while
the trunk that they read changes under them.

Shapes: B states, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from mujoban_planner.discrete_mpo import Answer, DiscreteMPOLearner, MPOSettings
from mujoban_planner.heads import PlannerOutput
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.push_policy import Anchor


class JointPlannerLearner(DiscreteMPOLearner):
    """Learns from what was decided while the stack played."""

    network: LearnedPlanner
    target: LearnedPlanner

    def __init__(self, config: MPOSettings, planner: LearnedPlanner, anchor: float) -> None:
        """Teach `planner` in place; hold its verdicts to what they are now, by so much, 0 for not at all."""
        self._anchor = Anchor(planner, anchor, 1.0) if anchor else None
        super().__init__(config, planner)

    def answers(self, network: nn.Module, states: Tensor) -> PlannerOutput:
        """Return what a planner says of states, [B, N, N, 4] with values in [0, 1]."""
        return network(states, follow=False)

    def further_losses(self, answer: Answer, states: Tensor) -> Mapping[str, Tensor]:
        """Return how far the verdicts have drifted."""
        assert isinstance(answer, PlannerOutput)
        return {} if self._anchor is None else {"drift": self._anchor.verdict_loss(answer, states)}
