"""Where a body that does not feel its heading faces, and which of its sides it puts ahead.

The ball's steer joint is its heading. A body on a free root has a gyro alone, whose turns sum up to a heading since the
start of the episode; how that lies in the map only the skyline shows, which is the same in all episodes. So a needle is
kept: what the frame shows of the heading is added to it in each tick, the longer the surer, and it turns with the robot
in between.

A body that is alike from all sides needs not turn round: it puts the side ahead that faces where the instruction leads.

Shapes: B robots, M ticks of any robots, F features of a frame, P proprioceptive values, S sides, U actuators.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn

from mujoban_controller.goal_features import feature_layout
from mujoban_core.bodies import Body
from mujoban_core.grid import CONTROL_PERIOD, INSTRUCTION_AXES, Instruction, turn_to_instruction

NEEDLE: Final = 2
"""Components of the needle: along the map's x-axis and its y-axis."""
_KEPT: Final = 0.9
"""Share of the needle that stays from tick to tick, so that it settles within a second."""
_SHORTEST: Final = 1e-3


class Compass(nn.Module):
    """The needle; has a layer, `read`, that reads the heading from a frame's features, [M, F] to [M, 2]."""

    def __init__(self, body: Body, features: int) -> None:
        """Read F features."""
        super().__init__()
        self._part = body.proprio
        self.read = nn.Linear(features, NEEDLE)

    def forward(self, shown: Tensor, proprio: Tensor, needle: Tensor) -> Tensor:
        """Return the needle after one more tick, [B, 2].

        Args:
            shown: What was read from the frame: the mean of unit vectors that may be the heading, [B, 2].
            proprio: o_pr, [B, P].
            needle: Before the tick, [B, 2]; zeros at an episode's start.
        """
        turned = CONTROL_PERIOD * self._part.turn_rate(proprio)
        cos, sin = turned.cos(), turned.sin()
        x, y = needle.unbind(-1)
        return _KEPT * torch.stack([cos * x - sin * y, sin * x + cos * y], -1) + shown


def heading_of(needle: Tensor) -> Tensor:
    """Return the unit vectors in which needles point, [..., 2]."""
    return needle / needle.norm(dim=-1, keepdim=True).clamp(min=_SHORTEST)


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
