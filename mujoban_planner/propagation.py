"""What spreads over the board by the rules, as input planes: where the robot can walk, where a box can be pushed.

A few convolutions cannot follow a winding way, and learning to do so costs most of a planner's training. These
planes follow it by a fixed max-min recursion (a value iteration whose transitions are the rules). They know nothing
of how boxes hinder each other and choose nothing, and they work on probabilities as on certain states.

Shapes: B states, I rows and columns of the interior, D = 4 directions, P = 3 planes.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional

from mujoban_core.grid import AGENT, BOX, OFFSETS_RC, TARGET

PLANES: Final = 3
"""Reachable, nearness to the robot, nearness of a lone box to a target."""
ITERATIONS: Final = 20
"""Steps that are followed; longer ways than this are rare on an interior of 8 x 8."""
_DECAY: Final = (1.0, 0.95, 0.9)
_WALK_DECAY: Final = 0.98
_DIRECTIONS: Final[list[list[int]]] = OFFSETS_RC[1:].tolist()
_OPPOSITE: Final = [2, 3, 0, 1]


def shifted(board: Tensor) -> Tensor:
    """Return what each cell's neighbour holds in each direction, [..., D, I, I] from [..., I, I]; 0 outside."""
    return torch.stack(_neighbours(functional.pad(board, (1, 1, 1, 1))), -3)


def _neighbours(padded: Tensor) -> list[Tensor]:
    """Return views of a board padded by one, [..., I + 2, I + 2], shifted in each direction, D of [..., I, I]."""
    size = padded.shape[-1] - 2
    return [padded[..., 1 + row : 1 + row + size, 1 + column : 1 + column + size] for row, column in _DIRECTIONS]


def propagate(planes: Tensor) -> Tensor:
    """Return the three planes, [B, P, I, I] with values in [0, 1].

    Args:
        planes: (floor, target, agent, box) with values in [0, 1], [B, 4, I, I].
    """
    floor, target, agent, box = planes[:, 0], planes[:, TARGET], planes[:, AGENT], planes[:, BOX]
    free = torch.minimum(floor, 1.0 - box)
    ahead = shifted(floor)  # Shape [B, D, I, I]
    # A box needs room on both sides; what may be pushed north may be pushed south.
    upright, sideways = (torch.minimum(torch.minimum(ahead[:, d], ahead[:, _OPPOSITE[d]]), floor) for d in (0, 1))
    # Filled rather than copied from a list, which nobody could do while a CUDA graph is captured.
    decay = torch.stack([planes.new_full((1, 1, 1), share) for share in _DECAY])
    start = torch.stack([agent, agent, target])
    spread = _spread(start, torch.stack([free, free, upright]), torch.stack([free, free, sideways]), decay)
    return spread.transpose(0, 1)


def legal_pushes(planes: Tensor, reachable: Tensor) -> Tensor:
    """Return how certainly the box in each cell can be pushed in each direction now, [B, D, I, I].

    Args:
        planes: (floor, target, agent, box), [B, 4, I, I].
        reachable: Where the robot can walk, [B, I, I].
    """
    floor, box = planes[:, 0], planes[:, BOX]
    ahead = shifted(torch.minimum(floor, 1.0 - box))
    behind = shifted(reachable)
    behind = torch.stack([behind[:, d] for d in _OPPOSITE], 1)
    return torch.minimum(torch.minimum(ahead, behind), box[:, None])


def walk_to_push(push: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return which instruction walks towards, and which executes, the pushes that are wanted.

    A value iteration: being where a wanted push starts has value, and value spreads over free cells.

    Args:
        push: Probability that the box in each cell is to be pushed next in each direction, [B, D, I, I].
        planes: (floor, target, agent, box), [B, 4, I, I].

    Returns:
        Steps gained by moving in each direction, clipped to [-1, 1], and the wanted pushes that start here relative to
        the most wanted one, both [B, D].
    """
    floor, agent, box = planes[:, 0], planes[:, AGENT], planes[:, BOX]
    free = torch.minimum(floor, 1.0 - box)
    # The scale is no part of what is learned: through it the most wanted push would get no gradient.
    wanted = push / push.amax((1, 2, 3), keepdim=True).detach().clamp(min=1e-6)
    # A push in direction d starts in the cell whose neighbour in direction d holds the box.
    boxes = _neighbours(functional.pad(wanted, (1, 1, 1, 1)))
    start = torch.stack([boxes[d][:, d] for d in range(4)], 1)  # Shape [B, D, I, I]
    value = _spread(torch.minimum(start.amax(1), free)[None], free[None], free[None], push.new_full((), _WALK_DECAY))[0]
    nearness = value.clamp(min=1e-6).log() / -math.log(_WALK_DECAY)
    gain = (shifted(value).clamp(min=1e-6).log() / -math.log(_WALK_DECAY) - nearness[:, None]).clamp(-1.0, 1.0)
    here = agent[:, None]
    return (gain * here).sum((2, 3)), (start * here).sum((2, 3))


@torch.no_grad()
def _spread(value: Tensor, upright: Tensor, sideways: Tensor, decay: Tensor) -> Tensor:
    """Return values [P, B, I, I] after they spread north and south, and east and west, as far as masks let them.

    The batch stands where pooling expects channels, so that it runs over contiguous numbers (channels-last): a batch
    of 128 takes a quarter of the time.
    """
    value, upright, sideways = (x.contiguous(memory_format=torch.channels_last) for x in (value, upright, sideways))
    for _ in range(ITERATIONS):
        vertical = torch.minimum(functional.max_pool2d(value, (3, 1), 1, (1, 0)), upright)
        horizontal = torch.minimum(functional.max_pool2d(value, (1, 3), 1, (0, 1)), sideways)
        value = torch.maximum(value, decay * torch.maximum(vertical, horizontal))
    return value
