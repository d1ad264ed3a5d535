"""What a planner network answers, and the read-out that answers it from features of the board.

Shapes: B states, I = 8 rows and columns of the interior, C channels, A = 5 instructions, D = 4 directions.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import AGENT, GRID_SIZE, Instruction
from mujoban_planner.propagation import legal_pushes, walk_to_push

INSTRUCTIONS: Final = len(Instruction)
INTERIOR: Final = GRID_SIZE - 2
WARINESS: Final = (0.7, 2.0)
"""Factor and summand of the logit of a push's verdict where a decision weighs it: what solved most of harder levels
than those that taught it (docs/research/planner.md). A small doubt counts then: 0.1 % as 5.5 %."""


class PlannerOutput(NamedTuple):
    """What a network says about abstract states."""

    policy: Tensor
    """Logits of the instructions, [B, A]."""
    q: Tensor
    """Q-value of each instruction in units of reward (paper C.2), [B, A]."""
    dead: Tensor
    """Logit of "no solution is left after this instruction", [B, A]; that of STAY judges the state itself."""
    plan: Tensor
    """Logits of the plan map, [B, A, I, I]: the direction in which a box will next be pushed out of each cell
    (STAY: none)."""
    push: Tensor
    """Log-probability that the next push is that of the box in each cell in each direction, [B, D, I, I]."""
    push_dead: Tensor | None
    """Logit of "no solution is left after this push", [B, D, I, I]; None for a network that does not judge pushes."""


class Advice(NamedTuple):
    """What a decision weighs: logarithms, which may be averages over views of the board."""

    policy: Tensor
    """Logits of the instructions before the way to a push counts, [B, A]."""
    alive: Tensor
    """log(1 - p(dead)) of each instruction, [B, A]."""
    push: Tensor
    """Log-probability of each next push, [B, D, I, I]."""
    push_alive: Tensor
    """log(1 - p(dead)) of each push, to the safe side (`verdicts`), [B, D, I, I]; zeros for a network that does
    not judge pushes."""


class Weighed(NamedTuple):
    """What comes out of a decision's forward pass."""

    score: Tensor
    """log pi(A | s) + caution * log(1 - p(dead | s, A)), [B, A]."""
    push: Tensor
    """Log-probability of each next push, the mean over the views so far, [B, D, I, I]."""
    push_alive: Tensor
    """log(1 - p(dead)) of each push, to the safe side, likewise."""
    alive: Tensor
    """log(1 - p(dead | s)) of the state itself, [B]."""


class PlannerHeads(nn.Module):
    """Policy, Q, dead-state, plan-map and push heads, reading the features at the robot's cell and over the board."""

    def __init__(
        self, channels: int, *, propagation: bool, judge: bool, hidden: int = 128, squeeze: int = 32
    ) -> None:
        """Build heads over `channels` features; the board is squeezed to `squeeze` channels per cell.

        With `propagation` the push head chooses among the legal pushes, and the policy reads from it, through a value
        iteration over the board, which way leads there. With `judge` as well, each push is judged where the box is,
        and what is judged deadly is not wanted.
        """
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeeze, 1)
        self.board = nn.Linear(squeeze * INTERIOR * INTERIOR + channels, hidden)
        self.policy = nn.Linear(hidden, INSTRUCTIONS)
        self.q = nn.Linear(hidden, INSTRUCTIONS)
        self.dead = nn.Linear(hidden, INSTRUCTIONS)
        self.plan = nn.Conv2d(channels, INSTRUCTIONS, 1)
        self.push = nn.Conv2d(channels, INSTRUCTIONS - 1, 1)
        self.walk = nn.Parameter(torch.tensor([4.0, 8.0])) if propagation else None
        self.push_dead = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, INSTRUCTIONS - 1, 1)
        ) if judge and propagation else None

    def forward(self, features: Tensor, planes: Tensor, reachable: Tensor | None) -> PlannerOutput:
        """Return the outputs; the policy's logits are those before the way to a push counts (`guide`).

        Args:
            features: [B, C, I, I].
            planes: (floor, target, agent, box), [B, 4, I, I].
            reachable: Where the robot can walk, [B, I, I]; None without propagation.
        """
        features = functional.relu(features)
        here = (features * planes[:, AGENT : AGENT + 1]).sum((2, 3))  # Shape [B, C]
        board = functional.relu(self.squeeze(features)).flatten(1)
        hidden = functional.relu(self.board(torch.cat([board, here], 1)))
        push = self.next_push(features, planes, reachable)
        push_dead = None if self.push_dead is None else self.push_dead(features).float()
        policy, q, dead = (head(hidden).float() for head in (self.policy, self.q, self.dead))
        return PlannerOutput(policy, q, dead, self.plan(features).float(), push, push_dead)

    def next_push(self, features: Tensor, planes: Tensor, reachable: Tensor | None) -> Tensor:
        """Return the log-probability of each next push, [B, D, I, I]; arguments as `forward`, features rectified."""
        push = self.push(features).float()
        if reachable is not None:
            push = push + (legal_pushes(planes, reachable) + 1e-4).log()
        return push - push.logsumexp((1, 2, 3), keepdim=True)

    def guide(self, wanted: Tensor, planes: Tensor) -> Tensor | float:
        """Return what the way to the pushes that are wanted adds to the policy's logits, [B, A]; 0 without propagation.

        Args:
            wanted: How much each push is wanted, a log-probability up to a constant, [B, D, I, I].
            planes: (floor, target, agent, box), [B, 4, I, I].
        """
        if self.walk is None:
            return 0.0
        wanted = wanted - wanted.amax((1, 2, 3), keepdim=True).detach()
        towards, start = walk_to_push(wanted.exp(), planes)
        return functional.pad(self.walk[0] * towards + self.walk[1] * start, (1, 0))


@torch.no_grad()
def silence_verdicts(heads: PlannerHeads) -> None:
    """Let a network that will never be taught what is deadly call nothing so; a decision weighs these verdicts."""
    verdicts = [heads.dead] if heads.push_dead is None else [heads.dead, heads.push_dead[-1]]
    for head in verdicts:
        assert isinstance(head, nn.Linear | nn.Conv2d) and head.bias is not None
        nn.init.zeros_(head.weight)
        nn.init.constant_(head.bias, -20.0)


class PoolAndInject(nn.Module):
    """Mean and maximum over the board, mapped to a bias per channel (Guez et al. 2019)."""

    def __init__(self, channels: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * channels, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, outputs, 1, 1] from [B, C, I, I]."""
        # Pooled so that the gradients come back channels-last, as the features are: a step takes 0.85 times as long.
        mean = x.permute(0, 2, 3, 1).flatten(1, 2).mean(1)
        maximum = functional.max_pool2d(x, x.shape[-2:]).flatten(1)
        return self.linear(torch.cat([mean, maximum], 1))[:, :, None, None]


def verdicts(output: PlannerOutput, *, wary: bool = False) -> Tensor:
    """Return log(1 - p(dead)) of each push, [B, D, I, I]; zeros where a network does not judge pushes.

    Args:
        output: What the network says.
        wary: Whether to return them as a decision weighs them, to the safe side, since a push can't be taken back.
    """
    if output.push_dead is None:
        return torch.zeros_like(output.push)
    factor, summand = WARINESS
    return log_alive(factor * output.push_dead + summand if wary else output.push_dead)


def as_said(wary: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the verdicts as the network says them, log(1 - p(dead)), of wary ones, of any shape."""
    factor, summand = WARINESS
    odds = np.maximum(-wary, np.finfo(np.float32).tiny)
    dead = (odds + np.log(-np.expm1(-odds)) - summand) / factor  # softplus, inverted
    return -np.logaddexp(np.float32(0.0), dead)


def log_alive(dead: Tensor) -> Tensor:
    """Return log(1 - p(dead)) of logits; as a softplus, which keeps its precision in an exported graph too."""
    return -functional.softplus(dead)
