"""A planner network as a policy over pushes, taught by the loss of a reinforcement learner, with a critic.

Shapes: B states, C channels, I = 8; A = 256 pushes, the flat index 64 * direction + square of the box.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_planner.boards import BitBoards, state_tensor
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.push_env import possible_masks
from mujoban_planner.reinforcement import silence_verdicts
from mujoban_planner.symmetry import push_images
from mujoban_sokoban.bitboard import SIDE

_IMPOSSIBLE = -1e9
"""Logit of a push that is not possible."""


class PushOutput(NamedTuple):
    """What a policy over pushes says of states."""

    logits: Tensor
    """Of pushes, `_IMPOSSIBLE` where they are not possible, [B, A]."""
    value: Tensor
    """Value of the state, [B]."""
    q: Tensor
    """Value of each push, 0 where it is not possible, [B, A]."""


class PushPolicy(nn.Module):
    """The push head of a planner network as policy, and a critic that reads the same features.

    The other heads get no gradient. Of a network that nothing was taught, those that would have a say in the planner's
    decision are masked, so that it goes by the push head alone; of another they keep their say, as they were taught
    before, and read a trunk that goes on changing under them.
    """

    def __init__(self, planner: LearnedPlanner, *, untaught: bool) -> None:
        """Wrap a network of the residual or recurrent architecture with propagation.

        Args:
            planner: Network; changed in place.
            untaught: Whether nothing was learned so far: mask what will never be taught.

        Raises:
            ValueError: If the network has no propagation, without which its decisions do not follow the push head.
        """
        super().__init__()
        if not planner.propagation:
            raise ValueError("a planner without propagation: expected one whose decisions follow its push head")
        self.planner = planner
        channels = int(planner.config["channels"])
        self.pushes = nn.Conv2d(channels, 4, 1)
        self.board = nn.Sequential(nn.Linear(2 * channels, 64), nn.ReLU(), nn.Linear(64, 1))
        last = self.board[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            for layer in (self.pushes, last):
                layer.weight.zero_()
            if untaught:
                silence_verdicts(planner)
                planner.heads.policy.weight.zero_()
                assert planner.heads.policy.bias is not None
                planner.heads.policy.bias.zero_()

    def forward(self, boards: BitBoards, symmetry: NDArray[np.int64] | None = None) -> PushOutput:
        """Return what the policy says of states, each under its symmetry if given, [B]."""
        possible = torch.from_numpy(possible_masks(boards))
        if symmetry is not None:
            possible = torch.zeros_like(possible).scatter_(1, push_images(SIDE)[torch.from_numpy(symmetry)], possible)
        features, _, _ = self.planner.perceive(state_tensor(boards, symmetry))
        features = functional.relu(features)
        logits = self.planner.heads.push(features).flatten(1).float()
        pooled = torch.cat([features.mean((2, 3)), features.amax((2, 3))], 1)
        value = self.board(pooled)[:, 0].float()
        q = value[:, None] + self.pushes(features).flatten(1).float()
        return PushOutput(logits.masked_fill(~possible, _IMPOSSIBLE), value, q.masked_fill(~possible, 0.0))


def images(pushes: NDArray[np.int64], symmetry: NDArray[np.int64]) -> Tensor:
    """Return where pushes, [B], stand under symmetries, [B]."""
    return push_images(SIDE)[torch.from_numpy(symmetry), torch.from_numpy(pushes)]
