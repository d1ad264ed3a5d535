"""Which cells of a map a camera has in view: of the true one for training and reports, of an estimate for decisions."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.camera import CameraMount
from mujoban_core.grid import GRID_SIZE

_RAYS: Final = 33
_STEP: Final = 0.15
_REACH: Final = 13.0
_NEAR: Final = 0.35
"""From here on a cell's content (up to the height of a box) is in the frame, in cells ahead of the camera."""


@njit(cache=True, nogil=True)
def _cast(
    wall: NDArray[np.bool_], pose: NDArray[np.float64], forward: float, half_angle: float, seen: NDArray[np.bool_]
) -> None:
    size = wall.shape[-1]
    half = (size - 1) / 2
    for n in range(pose.shape[0]):
        x0, y0, psi = pose[n]
        seen[n, int(np.rint(half - y0)) % size, int(np.rint(x0 + half)) % size] = True
        x0 += forward * math.cos(psi)
        y0 += forward * math.sin(psi)
        for ray in range(_RAYS):
            angle = psi + half_angle * (2.0 * ray / (_RAYS - 1) - 1.0)
            dx, dy = math.cos(angle), math.sin(angle)
            reach = _NEAR
            while reach < _REACH:
                row, col = int(np.rint(half - y0 - reach * dy)), int(np.rint(x0 + half + reach * dx))
                if not (0 <= row < size and 0 <= col < size):
                    break
                seen[n, row, col] = True
                if wall[n, row, col]:
                    break
                reach += _STEP


def cells_in_view(
    wall: NDArray[np.bool_], pose: NDArray[np.floating], mount: CameraMount, cell_size: float = 1.0
) -> NDArray[np.bool_]:
    """Return the cells that rays within the camera's field of view cross up to the first wall, [N, 10, 10].

    The robot's own cell counts as seen. Boxes hide nothing: the camera looks over them.

    Args:
        wall: true walls, [N, 10, 10].
        pose: (x [m], y [m], psi [rad]) in the map frame, [N, 3].
        mount: the body's camera, of which `forward` and `fovy` count.
        cell_size: edge of a cell in metres.
    """
    poses = np.array(pose, np.float64)
    poses[:, :2] /= cell_size
    seen = np.zeros((len(poses), GRID_SIZE, GRID_SIZE), np.bool_)
    _cast(np.ascontiguousarray(wall, np.bool_), poses, mount.forward / cell_size, math.radians(mount.fovy) / 2, seen)
    return seen
