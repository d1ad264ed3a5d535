"""Dead reckoning: how far a robot has come since its instruction began, by the velocities that it feels.

Shapes: B robots.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

TRACK: Final = 7
"""Values of a track."""


def dead_reckoning(track: Tensor, velocity: Tensor, heading: Tensor, terminated: Tensor, period: float) -> Tensor:
    """Return the track after one more tick, [B, 7].

    It holds the displacement since the instruction in force began (2), that during the instruction before (2), the
    velocity of this tick (2), all in the frame of `heading`, and whether there is one (1).

    Args:
        track: Before the tick, [B, 7]; zeros at an episode's start.
        velocity: In the robot's frame in cells per second, [B, 2].
        heading: Unit vector in which the robot faces, [B, 2].
        terminated: Whether a new instruction begins with this tick, [B].
        period: Seconds of a tick.
    """
    moved, before, last, known = track[:, :2], track[:, 2:4], track[:, 4:6], track[:, 6:]
    cos, sin = heading.unbind(-1)
    now = torch.stack(
        [velocity[:, 0] * cos - velocity[:, 1] * sin, velocity[:, 0] * sin + velocity[:, 1] * cos], -1
    )
    # Trapezoidal rule; an episode's first tick has nothing to come from.
    moved = moved + 0.5 * period * (now + last) * known
    new = terminated[:, None]
    before = torch.where(new, moved, before)
    moved = torch.where(new, torch.zeros_like(moved), moved)
    return torch.cat([moved, before, now, torch.ones_like(known)], -1)
