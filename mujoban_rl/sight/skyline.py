"""The heading by the skyline, which is the same in all episodes and stands out above the walls where these are low.

What a frame shows of it is laid out by direction: how the camera hangs and how the robot leans are known, so each
pixel's elevation is, and its azimuth as seen from the robot. By how much that strip has to be shifted to lie on the
panorama around is the heading. The panorama is learned, and what to look for in frames. So one frame of any heading
teaches all of them, and what is blind, such as a wall, comes to say nothing.

Shapes: M frames, N headings, A columns and R rows of the strip, C channels.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.camera import CameraMount

HEADINGS: Final = 128
"""N, evenly spaced, from east by north."""
_COLUMNS: Final = 37
"""A, as far apart as headings: 52 degrees to both sides."""
_LOWEST, _HIGHEST = -0.02, 0.36
"""Tangents of the elevations of the strip's last and first row: the horizon, and the tops of the highest buildings."""
_ROWS: Final = 12
_WIDTH, _CHANNELS = 16, 8
_INITIAL: Final = 0.02
"""Deviation of the panorama before it is learned."""
_BEHIND: Final = 0.05
"""Least depth of a direction: those beside or behind the camera fall out of the frame."""


class Skyline(nn.Module):
    """Logits of the heading, [M, N], from frames."""

    directions: Tensor
    azimuth: Tensor
    elevation: Tensor
    shift: Tensor

    def __init__(self, mount: CameraMount) -> None:
        """Look through a body's camera."""
        super().__init__()
        self._focal = 1.0 / math.tan(math.radians(mount.fovy) / 2)
        down, ahead = math.sin(mount.pitch), math.cos(mount.pitch)
        # Rows: image right, image down, optical axis, in the robot's frame.
        axes = [[0.0, -1.0, 0.0], [-down, 0.0, -ahead], [ahead, 0.0, -down]]
        columns = torch.arange(_COLUMNS) - _COLUMNS // 2
        self.register_buffer("directions", torch.tensor(axes), persistent=False)
        self.register_buffer("azimuth", columns * (math.tau / HEADINGS), persistent=False)
        self.register_buffer("elevation", torch.linspace(_HIGHEST, _LOWEST, _ROWS), persistent=False)
        self.register_buffer("shift", (torch.arange(HEADINGS)[:, None] + columns) % HEADINGS, persistent=False)
        self.encoder = nn.Sequential(
            nn.Conv2d(3, _WIDTH, 3, padding=1), nn.ReLU(), nn.Conv2d(_WIDTH, _CHANNELS, 3, padding=1), nn.ReLU()
        )
        self.panorama = nn.Parameter(_INITIAL * torch.randn(_CHANNELS * _ROWS, HEADINGS))

    def strip(self, frame: Tensor, up: Tensor) -> Tensor:
        """Return what frames show around the horizon, [M, 3, R, A], from -0.5 to 0.5; zeros where it is out of view.

        Args:
            frame: o_cam, [M, 64, 64, 3], up to 255.
            up: The world's z-axis in the robot's frame, [M, 3].
        """
        # The horizontal axes, ahead and to the left, in the robot's frame.
        ahead = functional.normalize(self.directions.new_tensor([1.0, 0.0, 0.0]) - up[:, :1] * up, dim=-1)
        left = torch.linalg.cross(up, ahead)
        level = self.azimuth.cos()[:, None] * ahead[:, None] + self.azimuth.sin()[:, None] * left[:, None]
        ray = level[:, None] + self.elevation[:, None, None] * up[:, None, None]
        across, down, depth = (ray @ self.directions.T).unbind(-1)
        place = self._focal * torch.stack([across, down], -1) / depth.clamp(min=_BEHIND)[..., None]
        image = frame.to(place.dtype).permute(0, 3, 1, 2) / 255.0 - 0.5
        return functional.grid_sample(image, place, align_corners=False)

    def forward(self, frame: Tensor, up: Tensor) -> Tensor:
        """Return logits of the headings, [M, N], given what `strip` takes."""
        seen = self.encoder(self.strip(frame, up)).flatten(1, 2)
        # One row for each heading: the panorama as it would look.
        return seen.flatten(1) @ self.panorama[:, self.shift].transpose(1, 2).flatten(0, 1)


def heading_loss(logits: Tensor, heading: Tensor) -> Tensor:
    """Return the mean cross-entropy of headings in radians, [...], given logits, [..., N]."""
    place = heading.flatten() * (HEADINGS / math.tau)
    below, share = place.floor().long(), (place - place.floor())[:, None]
    log = logits.flatten(0, -2).log_softmax(-1)
    lower, upper = (log.gather(-1, ((below + i) % HEADINGS)[:, None]) for i in (0, 1))
    return -((1.0 - share) * lower + share * upper).mean()


def unit(angle: Tensor) -> Tensor:
    """Return unit vectors, [..., 2], of angles in radians, [...]."""
    return torch.stack([angle.cos(), angle.sin()], -1)
