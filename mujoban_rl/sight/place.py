"""Where within its cell a robot is, which a controller has to know to keep to its lane.

Pegs and walls stand on the lattice of cells, so a frame shows where in a cell its viewer is, though not in which: a
phase along the axis that it faces, up to quarter turns, and one to the left of it. So a needle is kept for each axis of
the map, which turns once for each cell: what a frame shows is added to it, and it goes with what the robot feels of its
motion in between.

Shapes: B robots, F features of a frame.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import turn_to_instruction
from mujoban_rl.sight.skyline import unit

PLACE: Final = 4
"""Components of the needles: cosines of the phases along two axes, then their sines; zero in the middle of a cell."""
_KEPT: Final = 0.95
"""Share of the needles that stays from tick to tick."""


class Place(nn.Module):
    """The needles; has a layer, `read`, that reads the phases from a frame's features, [M, F] to [M, `PLACE`]."""

    def __init__(self, features: int) -> None:
        """Read F features."""
        super().__init__()
        self.read = nn.Linear(features, PLACE)

    def forward(self, shown: Tensor, heading: Tensor, moved: Tensor, place: Tensor) -> Tensor:
        """Return the needles after one more tick, [B, `PLACE`], along x and y of the map.

        Args:
            shown: What the frame shows of the phases, ahead and to the left, [B, `PLACE`].
            heading: Unit vectors in which the robots face, [B, 2].
            moved: Displacement since the tick before, in the map's frame in cells, [B, 2].
            place: Before the tick; zeros at an episode's start.
        """
        cosine, sine = place.split(2, -1)
        turn = math.tau * moved
        carried = torch.cat(turn_to_instruction(cosine, sine, turn.cos(), -turn.sin()), -1)
        ahead = _axis_ahead(heading.detach())
        back = torch.stack([ahead[..., 0], -ahead[..., 1]], -1)
        return _KEPT * carried + (1.0 - _KEPT) * phases_along(shown, back)


def way_left(place: Tensor, since: Tensor, step: Tensor) -> Tensor:
    """Return the way to the middle of the cell to which the instruction leads, along x and y of the map, [B, 2] cells.

    A needle says where a robot is in some cell, not in which: it counts from the cell in whose bounds it was when the
    instruction began. No gradient passes: what a frame shows is learned from poses.

    Args:
        place: The needles, [B, `PLACE`].
        since: Displacement since the instruction began, in the map's frame in cells, [B, 2].
        step: To the next cell as the instruction says, in the map's frame in cells, [B, 2].
    """
    cosine, sine = place.detach().split(2, -1)
    start = torch.atan2(sine, cosine) / math.tau - since
    return step - since - (start - start.round())


def _axis_ahead(heading: Tensor) -> Tensor:
    """Return the axis of the map that headings [..., 2] are nearest to, unit vectors [..., 2]."""
    east = heading[..., :1].abs() >= heading[..., 1:].abs()
    return torch.where(torch.cat([east, ~east], -1), heading.sign(), 0.0)


def phases_along(place: Tensor, axis: Tensor) -> Tensor:
    """Return phases along x and y, [..., `PLACE`], as those along an axis and to its left.

    Args:
        place: As `PLACE` says.
        axis: Unit vectors along x or y, [..., 2]; broadcast.
    """
    (x_cos, y_cos), (x_sin, y_sin) = place[..., :2].unbind(-1), place[..., 2:].unbind(-1)
    x, y = axis.unbind(-1)
    along, left = turn_to_instruction(x_sin, y_sin, x, y)
    # The lattice looks the same from both sides of a cell's middle, so a cosine has no sign to turn.
    return torch.stack([x.abs() * x_cos + y.abs() * y_cos, x.abs() * y_cos + y.abs() * x_cos, along, left], -1)


def phases(pose: Tensor, cell_size: float) -> Tensor:
    """Return the phases along x and y, [..., `PLACE`], of poses (x [m], y [m], psi), [..., 3]."""
    phase = math.tau * (pose[..., :2] / cell_size - 0.5)
    return torch.cat([phase.cos(), phase.sin()], -1)


def place_loss(shown: Tensor, pose: Tensor, cell_size: float) -> Tensor:
    """Return how far what frames show of phases, [..., `PLACE`], is off poses (x [m], y [m], psi), [..., 3]."""
    heading = unit(pose[..., 2])
    # Squares make it the mean of what may be: short where a frame shows little.
    return functional.mse_loss(shown, phases_along(phases(pose, cell_size), _axis_ahead(heading)))


def cells_off(place: Tensor, pose: Tensor, cell_size: float) -> Tensor:
    """Return by how many cells needles, [..., `PLACE`], are off poses (x [m], y [m], psi), along x and y, [..., 2]."""
    cosine, sine = turn_to_instruction(*place.split(2, -1), *phases(pose, cell_size).split(2, -1))
    return torch.atan2(sine, cosine).abs() / math.tau
