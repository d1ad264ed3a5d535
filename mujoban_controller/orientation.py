"""Where a body that does not feel its heading faces.

The ball's steer joint is its heading. A body on a free root has a gyro alone, whose turns sum up to a heading since the
start of the episode; how that lies in the map only the frames tell. Lines of floor and walls, which are nearly always
in view, show it up to quarter turns; which of the four it is the skyline shows, the same in all episodes, wherever it
stands out above the walls (`skyline`). So a needle is kept, of two hands: what a frame shows is added to them, the
surer the longer, and they turn with the robot in between.

Shapes: B robots, M ticks of any robots, F features of a frame, P proprioceptive values.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.skyline import HEADINGS, Skyline, heading_loss, mean_of, unit
from mujoban_core.bodies import Body
from mujoban_core.grid import CONTROL_PERIOD, turn_to_instruction

NEEDLE: Final = 4
"""Components of the needle: of a hand that points in the heading, along the map's x-axis and its y-axis, and of one
that turns four times as fast, so that quarter turns are alike."""
SIGHT: Final = HEADINGS + 2
"""What a frame shows of the heading: logits by the skyline, and the second hand by the lines."""
_REMEMBERED: Final = 0.99
"""Share of the first hand that stays from tick to tick: the skyline is out of view for long."""
_KEPT: Final = 0.9
"""The same for the second, so that it settles within a second."""
_SUREST: Final = 0.97
"""Longest mean vector of what the skyline shows that counts: frames in succession err alike."""
_QUARTERS: Final = 4
_SHORTEST: Final = 1e-3


class Compass(nn.Module):
    """The needle, and what reads the heading from a frame."""

    def __init__(self, body: Body, features: int) -> None:
        """Read F features."""
        super().__init__()
        self._part = body.proprio
        self.skyline = Skyline(body.camera)
        self.lines = nn.Linear(features, 2)

    def read(self, frame: Tensor, features: Tensor, proprio: Tensor) -> Tensor:
        """Return what frames show of the heading, [M, `SIGHT`].

        Args:
            frame: o_cam, [M, 64, 64, 3], up to 255.
            features: What the encoder made of it, [M, F].
            proprio: o_pr, [M, P].
        """
        return torch.cat([self.skyline(frame, proprio[:, self._part.up_axis]), self.lines(features)], -1)

    def forward(self, shown: Tensor, proprio: Tensor, needle: Tensor) -> Tensor:
        """Return the needle after one more tick, [B, `NEEDLE`].

        Args:
            shown: What the frame shows, [B, `SIGHT`].
            proprio: o_pr, [B, P].
            needle: Before the tick; zeros at an episode's start.
        """
        turned = CONTROL_PERIOD * self._part.turn_rate(proprio)
        first, second = needle.split(2, -1)
        skyline = mean_of(shown[..., :HEADINGS])
        first = _REMEMBERED * _turn(first, turned) + _concentration(skyline) * skyline
        second = _KEPT * _turn(second, _QUARTERS * turned) + shown[..., HEADINGS:]
        # The gyro's sum strays by ten degrees within 200 ticks; the lines hold it.
        return torch.cat([first.norm(dim=-1, keepdim=True) * _nearest(first, second), second], -1)


def sight_loss(shown: Tensor, heading: Tensor) -> Tensor:
    """Return how far what frames show, [..., `SIGHT`], is off headings in radians, [...]."""
    # Squares make the second hand the mean of what may be: short where a frame shows little.
    lines = functional.mse_loss(shown[..., HEADINGS:], unit(_QUARTERS * heading))
    return lines + heading_loss(shown[..., :HEADINGS], heading)


def _turn(vector: Tensor, angle: Tensor) -> Tensor:
    """Return vectors [..., 2] turned to the left by angles [...]."""
    x, y = vector.unbind(-1)
    return torch.stack(turn_to_instruction(x, y, angle.cos(), -angle.sin()), -1)


def _concentration(mean: Tensor) -> Tensor:
    """Return how much mean vectors [..., 2] of headings say, [..., 1]: the concentration over their length.

    That of a von Mises distribution, as Banerjee et al. (2005) approximate it.
    """
    squared = mean.square().sum(-1, keepdim=True).clamp(max=_SUREST**2)
    return (2.0 - squared) / (1.0 - squared)


def _angle(vector: Tensor) -> Tensor:
    """Return the angles of vectors [..., 2], [...]; of none it is zero, with a slope."""
    return torch.atan2(vector[..., 1], vector[..., 0] + _SHORTEST * (vector.detach().abs().sum(-1) < _SHORTEST))


def _nearest(first: Tensor, second: Tensor) -> Tensor:
    """Return the unit vectors, [..., 2], that the second hand may mean and that are nearest to the first."""
    fine = _angle(second) / _QUARTERS
    quarter = math.tau / _QUARTERS
    return unit(fine + quarter * torch.round((_angle(first.detach()) - fine.detach()) / quarter))


def heading_of(needle: Tensor) -> Tensor:
    """Return the unit vectors in which needles point, [..., 2]: their first hand, which the lines have set right."""
    return functional.normalize(needle[..., :2], dim=-1)
