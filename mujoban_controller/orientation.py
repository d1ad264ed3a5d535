"""Where a body that does not feel its heading faces, and which of its sides it puts ahead.

The ball's steer joint is its heading. A body on a free root has a gyro alone, whose turns sum up to a heading since the
start of the episode; how that lies in the map only the frames tell. Lines of floor and walls, which are nearly always
in view, show it up to quarter turns; which of the four it is the skyline shows, the same in all episodes, wherever it
stands out above the walls (`skyline`). So a needle is kept, of two hands: what a frame shows is added to them, the
surer the longer, and they turn with the robot in between.

A body that is alike from all sides needs not turn round: it puts the side ahead that faces where the instruction leads.

Shapes: B robots, M ticks of any robots, F features of a frame, P proprioceptive values, S sides, U actuators.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.goal_features import feature_layout
from mujoban_controller.skyline import HEADINGS, Skyline, heading_loss, mean_of, unit
from mujoban_core.bodies import Body
from mujoban_core.grid import CONTROL_PERIOD, INSTRUCTION_AXES, Instruction, turn_to_instruction

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
        heading = heading_of(torch.cat([first, second], -1))
        return torch.cat([first.norm(dim=-1, keepdim=True) * heading, second], -1)


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


def heading_of(needle: Tensor) -> Tensor:
    """Return the unit vectors in which needles point, [..., 2]: the second hand's nearest to the first."""
    first, second = needle.split(2, -1)
    fine = _angle(second) / _QUARTERS
    quarter = math.tau / _QUARTERS
    return unit(fine + quarter * torch.round((_angle(first.detach()) - fine.detach()) / quarter))


class Sides(nn.Module):
    """What a body feels and does, as the side that it puts ahead sees it; nothing is learned."""

    source: Tensor
    sign: Tensor
    own: Tensor
    axes: Tensor

    def __init__(self, body: Body) -> None:
        """Read the symmetries of a body."""
        super().__init__()
        layout = feature_layout(body)
        order = torch.from_numpy(layout.actuators)
        self.count = len(order)
        """S."""
        self.register_buffer("source", torch.from_numpy(layout.proprio.source), persistent=False)
        self.register_buffer("sign", torch.from_numpy(layout.proprio.sign), persistent=False)
        self.register_buffer("own", order.argsort(1), persistent=False)
        self.register_buffer("axes", torch.tensor(INSTRUCTION_AXES, dtype=torch.float32), persistent=False)

    def ahead(self, heading: Tensor, instruction: Tensor) -> Tensor:
        """Return the side, in quarter turns to the left, that faces where an instruction leads, int64 [B].

        Args:
            heading: Unit vectors, [B, 2].
            instruction: A, int64 [B]; with STAY the front stays ahead.
        """
        x, y = self.relative(heading.detach(), instruction, torch.zeros_like(instruction)).unbind(-1)
        side = torch.round(torch.atan2(y, x) / (math.pi / 2)).long() % self.count
        return torch.where(instruction == int(Instruction.STAY), 0, side)

    def relative(self, heading: Tensor, instruction: Tensor, side: Tensor) -> Tensor:
        """Return the direction of instructions as the side ahead sees it, (ahead, left), [M, 2]."""
        front = turn_to_instruction(*self.axes[instruction].unbind(-1), *heading.unbind(-1))
        quarter = side * (math.pi / 2)
        return torch.stack(turn_to_instruction(*front, quarter.cos(), quarter.sin()), -1)

    def felt(self, proprio: Tensor, side: Tensor) -> Tensor:
        """Return proprioception as the side ahead sees it, [M, P]."""
        return self.sign[side] * proprio.gather(-1, self.source[side])

    def torques(self, action: Tensor, side: Tensor) -> Tensor:
        """Return the body's torques, [M, U], of actions in the order in which the side ahead sees them."""
        return action.gather(-1, self.own[side])
