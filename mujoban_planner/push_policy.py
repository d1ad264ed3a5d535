"""A planner network as a policy over pushes, taught by the loss of a reinforcement learner, with a critic.

Shapes: B states, N = `grid.GRID_SIZE`, C channels, D = 4 directions, I = 8; A = 256 pushes, the flat index
64 * direction + square of the box.
"""

from __future__ import annotations

from copy import deepcopy
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_planner.boards import BitBoards, state_tensor
from mujoban_planner.heads import PlannerOutput, silence_verdicts
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.propagation import legal_pushes, propagate
from mujoban_planner.push_env import possible_masks
from mujoban_planner.symmetry import push_images
from mujoban_sokoban.bitboard import SIDE

_IMPOSSIBLE = -1e9
"""Logit of a push that is not possible."""


class PushOutput(NamedTuple):
    """What a policy over pushes says of states."""

    logits: Tensor
    """Of pushes, `_IMPOSSIBLE` where they are not possible, [B, A]."""
    stray: Tensor
    """-log of the probability that the push head gives to what is possible, [B], 0 where nothing is. A learner lets it
    be small: here what is impossible is masked, in the planner's decision it is not."""
    value: Tensor
    """Value of the state, [B]."""
    q: Tensor
    """Value of each push, 0 where it is not possible, [B, A]."""


class PushPolicy(nn.Module):
    """The push head of a planner network as policy, and a critic that reads the same features.

    The other heads get no gradient. Of a network that nothing was taught, those that would have a say in the planner's
    decision are masked, so that it goes by the push head alone; of another they keep their say, as they were taught
    before, which an `Anchor` holds them to while the trunk that they read goes on changing under them.
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
                silence_verdicts(planner.heads)
                planner.heads.policy.weight.zero_()
                assert planner.heads.policy.bias is not None
                planner.heads.policy.bias.zero_()

    def forward(self, boards: BitBoards, symmetry: NDArray[np.int64] | None = None) -> PushOutput:
        """Return what the policy says of states, each under its symmetry if given, [B]."""
        possible = _possible(boards, symmetry)
        features, planes, reachable = self.planner.perceive(state_tensor(boards, symmetry))
        features = functional.relu(features)
        push = self.planner.heads.next_push(features, planes, reachable).flatten(1)
        logits = push.masked_fill(~possible, _IMPOSSIBLE)
        stray = -torch.where(possible.any(1), logits.logsumexp(1), 0.0)
        pooled = torch.cat([features.mean((2, 3)), features.amax((2, 3))], 1)
        value = self.board(pooled)[:, 0].float()
        q = value[:, None] + self.pushes(features).flatten(1).float()
        return PushOutput(logits, stray, value, q.masked_fill(~possible, 0.0))


class Anchor:
    """What a planner said when a run began, for the heads that the run does not teach."""

    def __init__(self, planner: LearnedPlanner, weight: float, share: float) -> None:
        """Keep a copy of the planner.

        Args:
            planner: As it is when the run begins.
            weight: Of the loss.
            share: Share of the states of a batch in which it is asked, from the first on.
        """
        self._before = deepcopy(planner).eval().requires_grad_(False)
        self._weight, self._share = weight, share

    def loss(self, planner: LearnedPlanner, boards: BitBoards, symmetry: NDArray[np.int64] | None = None) -> Tensor:
        """Return how far the planner's policy, plan map, verdicts and Q have come from those of the beginning.

        The policy is that before the way to a push counts, since the pushes that are wanted are to change.
        Cross-entropies less what they are at least, and the smooth L1 distance of Q: 0 where nothing has changed.

        Args:
            planner: The one that learns.
            boards: States, [B].
            symmetry: Of each, [B]; none by default.
        """
        n = max(1, round(self._share * len(boards.box)))
        boards = BitBoards._make(column[:n] for column in boards)
        symmetry = None if symmetry is None else symmetry[:n]
        state = state_tensor(boards, symmetry)
        before, _ = self._before.read(state)
        now, _ = planner.read(state)
        loss = functional.smooth_l1_loss(now.q, before.q)
        for new, old in ((now.policy, before.policy), (now.plan, before.plan)):
            spread = functional.kl_div(new.log_softmax(1), old.log_softmax(1), reduction="none", log_target=True)
            loss = loss + spread.sum(1).mean()
        possible = _possible(boards, symmetry).view_as(now.push)
        return self._weight * (loss + _verdict_divergence(now, before, possible))

    def verdict_loss(self, now: PlannerOutput, states: Tensor) -> Tensor:
        """Return how far the verdicts alone have come from those of the beginning, in all states, which may be unsure.

        Args:
            now: What the planner that learns says of them.
            states: [B, N, N, 4] with values in [0, 1].
        """
        with torch.no_grad():
            before, planes = self._before.read(states)
            possible = legal_pushes(planes, propagate(planes)[:, 0])
        return self._weight * _verdict_divergence(now, before, possible)


def _verdict_divergence(now: PlannerOutput, before: PlannerOutput, possible: Tensor) -> Tensor:
    """Return the mean KL(before || now) of the verdicts on instructions, plus that of the verdicts on pushes.

    Args:
        now: Of the one that learns.
        before: Of the one that it was.
        possible: How certainly each push is possible, [B, D, I, I]: of others nobody asks.
    """
    loss = _bernoulli_divergence(now.dead, before.dead).mean()
    if now.push_dead is None or before.push_dead is None:
        return loss
    drift = _bernoulli_divergence(now.push_dead, before.push_dead)
    return loss + (drift * possible).sum() / possible.sum().clamp(min=1e-6)


def _possible(boards: BitBoards, symmetry: NDArray[np.int64] | None) -> Tensor:
    """Return which pushes are possible in states as they stand under their symmetries, [B, A]."""
    possible = torch.from_numpy(possible_masks(boards))
    if symmetry is None:
        return possible
    return torch.zeros_like(possible).scatter_(1, push_images(SIDE)[torch.from_numpy(symmetry)], possible)


def _bernoulli_divergence(new: Tensor, old: Tensor) -> Tensor:
    """Return KL(old || new) of probabilities given as logits, element by element."""
    p = old.sigmoid()
    return functional.softplus(new) - functional.softplus(old) - p * (new - old)


def images(pushes: NDArray[np.int64], symmetry: NDArray[np.int64]) -> Tensor:
    """Return where pushes, [B], stand under symmetries, [B]."""
    return push_images(SIDE)[torch.from_numpy(symmetry), torch.from_numpy(pushes)]
