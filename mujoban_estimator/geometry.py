"""Where the cells of the map are, seen from the robot: the geometric inputs of the attention (paper C.1, Fig. 6).

Shapes: N frames, M = 100 cells in row-major order, A = 3 anchors of a cell.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.camera import FRAME_SIZE, CameraMount, project
from mujoban_core.grid import GRID_SIZE, cell_to_xy, turn_to_instruction

CELLS: Final = GRID_SIZE * GRID_SIZE
ANCHORS: Final[tuple[tuple[float, float], ...]] = ((0.0, 0.0), (0.0, 0.3), (0.5, 0.25))
"""Points of a cell that show what it holds: (shift towards the robot, height), both in cells.

Floor at the centre (target pads), the top of a box, and the face of a box or wall.
"""
FEATURES: Final = 9
"""Relative coordinates of a cell; see `relative_features`."""

_MIN_DEPTH: Final = 0.1
_MARGIN: Final = 1.25
"""An anchor counts as in view up to this far from the optical axis, in half frames: features reach over the edge."""


class CellGeometry(NamedTuple):
    """Geometry of all cells in each frame."""

    features: NDArray[np.float32]
    """Coordinates relative to the robot, [N, M, FEATURES]."""
    pixels: NDArray[np.float32]
    """Where the anchors project to: (right, down), -1 to 1 over the frame, clipped to [-1.5, 1.5]; [N, M, A, 2]."""
    visible: NDArray[np.float32]
    """Whether the anchors are within the frame, occlusion aside, [N, M, A]."""


def _cell_centres() -> NDArray[np.float64]:
    """Return the centres of all cells in a world with cells of 1 m, [M, 2]."""
    rows, cols = np.divmod(np.arange(CELLS), GRID_SIZE)
    return cell_to_xy(np.stack([rows, cols], axis=-1))


_CENTRES: Final = _cell_centres()


def relative_features(pose: NDArray[np.floating], cell_size: float) -> NDArray[np.float32]:
    """Return (x, y, psi) of every cell relative to the robot, with distance terms that are steep nearby.

    Args:
        pose: (x [m], y [m], psi [rad]) in the map frame, [N, 3].
        cell_size: edge of a cell in metres.
    """
    cells = pose[:, :2] / cell_size
    offset = _CENTRES[None] - cells[:, None]
    cos, sin = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    ahead, left = turn_to_instruction(offset[..., 0], offset[..., 1], cos, sin)
    distance = np.hypot(ahead, left)
    turn = np.broadcast_to(np.concatenate([cos, sin], axis=1)[:, None], (*distance.shape, 2))
    columns = [
        ahead / 4, left / 4, distance / 4, ahead / (distance + 0.2), left / (distance + 0.2),
        1 / (distance + 0.5), np.exp(-((distance / 0.4) ** 2)),
    ]  # fmt: skip
    return np.concatenate([np.stack(columns, axis=-1), turn], axis=-1).astype(np.float32)


def cell_geometry(pose: NDArray[np.floating], mount: CameraMount, cell_size: float) -> CellGeometry:
    """Return the geometry of all cells for robots with the given poses, [N, 3]."""
    pose = np.asarray(pose, np.float64)
    centres = _CENTRES * cell_size
    towards = pose[:, None, :2] - centres
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    # Nearest to the robot within the cell: never beyond the robot itself.
    towards *= np.minimum(cell_size, distance) / np.maximum(distance, 1e-6)
    shift = np.array([a[0] for a in ANCHORS])
    height = np.array([a[1] for a in ANCHORS]) * cell_size
    points = np.empty((len(pose), CELLS, len(ANCHORS), 3))
    points[..., :2] = centres[None, :, None] + shift[:, None] * towards[:, :, None]
    points[..., 2] = height
    pixels, depth = project(points.reshape(len(pose), -1, 3), pose, mount)
    pixels = (pixels.reshape(len(pose), CELLS, len(ANCHORS), 2) + 0.5) * (2.0 / FRAME_SIZE) - 1.0
    depth = depth.reshape(len(pose), CELLS, len(ANCHORS))
    visible = (depth > _MIN_DEPTH) & (np.abs(pixels).max(axis=-1) < _MARGIN)
    return CellGeometry(
        relative_features(pose, cell_size),
        np.clip(pixels, -1.5, 1.5).astype(np.float32),
        visible.astype(np.float32),
    )
