"""Dead reckoning: how far a robot comes by what it feels of its velocity. It has no weights.

What is summed up from it, since when, is for who asks: control termination from the start of an episode, the
controller from that of an instruction.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mujoban_core.bodies import Body
from mujoban_core.grid import CONTROL_PERIOD, turn_to_instruction


def map_velocity(body: Body, proprio: Tensor, heading: Tensor) -> Tensor:
    """Return velocities along the axes of the map in cells per second, [..., 2].

    Args:
        body: The robot's body.
        proprio: o_pr, [..., P].
        heading: Unit vectors in which the robots face, [..., 2].
    """
    ahead, left = (proprio[..., body.proprio.planar_velocity] / body.cell_size).unbind(-1)
    return torch.stack(turn_to_instruction(ahead, left, heading[..., 0], -heading[..., 1]), -1)


def displacement(before: Tensor, velocity: Tensor) -> Tensor:
    """Return how far robots come in a tick, [..., 2] in cells, by the trapezoidal rule.

    Args:
        before: Velocity in the tick before, [..., 2] in cells per second.
        velocity: In this tick.
    """
    return 0.5 * CONTROL_PERIOD * (before + velocity)
