"""Pinhole geometry of the robot's camera, in NumPy: where a point of the map appears in a frame.

The simulator's renderer and ``camera_info``, and the estimator's projective attention, all use these functions.

Frames follow REP 103: ``map`` is x east, y north, z up; the optical frame of the camera is x right, y down,
z forward. Pixels are (u, v) = (column, row) with row 0 at the top; integer values are pixel centres, so an image
of `size` pixels spans -0.5 to size - 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FRAME_SIZE = 64
"""Rows and columns of the frames that the modules see (paper appendix B)."""
TOP_DOWN_CAMERA: Final = "top_down"
"""Name of the camera that sees the whole grid from above, north up; it yields o_top."""


@dataclass(frozen=True)
class CameraMount:
    """How a body carries its first-person camera; it looks along the robot's heading."""

    forward: float
    """Metres in front of the body's vertical axis."""
    height: float
    """Metres above the floor when the robot stands upright."""
    pitch: float
    """Radians by which the optical axis points below the horizon."""
    fovy: float
    """Vertical field of view in degrees (pixels are square)."""

    def mjcf(self, name: str, origin_height: float) -> str:
        """Return the ``<camera>`` element for a body whose origin is `origin_height` metres above the floor."""
        up = f"{math.sin(self.pitch)} 0 {math.cos(self.pitch)}"
        position = f"{self.forward} 0 {self.height - origin_height}"
        return f'<camera name="{name}" pos="{position}" xyaxes="0 -1 0 {up}" fovy="{self.fovy}"/>'


class Projection(NamedTuple):
    """Where points appear in a frame."""

    pixels: NDArray[np.float64]
    """(u, v) in pixels, [..., 2]; meaningless where `depth` <= 0."""
    depth: NDArray[np.float64]
    """Distance along the optical axis in metres, [...]; negative behind the camera."""


def camera_intrinsics(mount: CameraMount, size: int = FRAME_SIZE) -> NDArray[np.float64]:
    """Return the intrinsic matrix K of a square frame of `size` pixels, [3, 3] (``CameraInfo.k``)."""
    focal = 0.5 * size / math.tan(0.5 * math.radians(mount.fovy))
    centre = 0.5 * (size - 1)
    return np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])


def camera_extrinsics(mount: CameraMount, pose: ArrayLike) -> NDArray[np.float64]:
    """Return the transforms that take homogeneous map points to the optical frame, [..., 4, 4].

    Args:
        mount: the body's camera.
        pose: robot pose (x [m], y [m], psi [rad]) in the map frame, [..., 3].
    """
    p = np.asarray(pose, dtype=np.float64)
    cos, sin = np.cos(p[..., 2]), np.sin(p[..., 2])
    cp, sp = math.cos(mount.pitch), math.sin(mount.pitch)
    transform = np.zeros((*p.shape[:-1], 4, 4))
    # Rows: image right, image down, optical axis, each a unit vector of the map frame.
    transform[..., 0, 0], transform[..., 0, 1] = sin, -cos
    transform[..., 1, 0], transform[..., 1, 1], transform[..., 1, 2] = -sp * cos, -sp * sin, -cp
    transform[..., 2, 0], transform[..., 2, 1], transform[..., 2, 2] = cp * cos, cp * sin, -sp
    # The camera's place, turned into the optical frame: only `along` and `across` depend on the pose.
    along, across = p[..., 0] * cos + p[..., 1] * sin + mount.forward, p[..., 0] * sin - p[..., 1] * cos
    transform[..., 0, 3] = -across
    transform[..., 1, 3] = sp * along + cp * mount.height
    transform[..., 2, 3] = sp * mount.height - cp * along
    transform[..., 3, 3] = 1.0
    return transform


def _to_optical(points: ArrayLike, pose: ArrayLike, mount: CameraMount) -> NDArray[np.float64]:
    """Return map points [..., N, 3] in the optical frames of the cameras."""
    transform = camera_extrinsics(mount, pose)
    turned = np.asarray(points, dtype=np.float64) @ np.swapaxes(transform[..., :3, :3], -1, -2)
    return turned + transform[..., None, :3, 3]


def project(points: ArrayLike, pose: ArrayLike, mount: CameraMount, size: int = FRAME_SIZE) -> Projection:
    """Return where points of the map appear in the frames of robots.

    Args:
        points: (x, y, z) in the map frame in metres, [..., N, 3]; leading axes broadcast with those of `pose`.
        pose: robot pose (x [m], y [m], psi [rad]) in the map frame, [..., 3].
        mount: the body's camera.
        size: rows and columns of the frame.

    Returns:
        Pixels [..., N, 2] and depth [..., N].
    """
    intrinsics = camera_intrinsics(mount, size)
    # Shape [..., N, 3].
    optical = _to_optical(points, pose, mount)
    depth = optical[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    pixels = optical[..., :2] / safe[..., None] * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2]
    return Projection(pixels, depth)


def in_view(points: ArrayLike, radius: ArrayLike, pose: ArrayLike, mount: CameraMount) -> NDArray[np.bool_]:
    """Return whether spheres may be seen by the cameras of robots, occlusion aside.

    Args:
        points: centres (x, y, z) in the map frame in metres, [..., N, 3].
        radius: in metres, broadcast to [..., N].
        pose: robot pose (x [m], y [m], psi [rad]) in the map frame, [..., 3].
        mount: the body's camera.

    Returns:
        [..., N]; false only if no part of the sphere is in the frame.
    """
    optical = _to_optical(points, pose, mount)
    half = math.radians(mount.fovy) / 2
    reach = np.asarray(radius, dtype=np.float64)
    # A sphere is outside if it lies beyond one of the frame's side planes, or behind.
    bound = optical[..., 2] * math.tan(half) + reach / math.cos(half)
    return (optical[..., 2] > -reach) & (np.abs(optical[..., :2]).max(axis=-1) < bound)
