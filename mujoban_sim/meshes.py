"""The static part of a level (floor, walls, pegs) and the skyline as triangle meshes with texture coordinates.

A level is one mesh with one texture, an *atlas*: bands stacked along v, each of which tiles along u with a
period of one cell. So runs of cells are single quads and a level is drawn by one call.

Shapes: Q quads, corners counter-clockwise as seen from the front.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import GRID_SIZE, cell_to_xy
from mujoban_sim.scene import PEG_HALF_DIAGONAL, PEG_HEIGHT, peg_corners

BANDS: Final = ("side", "top", "floor", "peg")
"""Bands of the atlas along v, from v = 0."""

MAX_QUADS: Final = GRID_SIZE**2 + 2 * GRID_SIZE * (GRID_SIZE - 1) + 5 * (GRID_SIZE - 1) ** 2
"""Quads that a level can need: a floor or top per cell, a side per inner edge, five per inner corner's peg."""

SKYLINE_ROWS: Final = 128
"""Rows of the skyline's texture."""
SKYLINE_RADIUS: Final = 60.0
"""Radius of the skyline's ring in cells."""
SKYLINE_HEIGHTS: Final = (-0.36, 0.0, 0.32, 0.85)
"""Heights of its rings as tangents of the elevation: ground, horizon, top of the buildings, sky."""
SKYLINE_V: Final = (0.0, 0.125, 0.875, 1.0)
"""Texture coordinate v at those heights: buildings get most of the texture."""
_SKY_TOP: Final = 3.0
"""Tangent of the elevation up to which there is sky: a robot that leans back sees higher than the skyline's texture."""
_SKY_V: Final = 1.0 - 0.5 / SKYLINE_ROWS
"""The middle of the texture's last row: its edge would show half of the first one, the ground."""
_SKYLINE_SEGMENTS: Final = 16


class Mesh(NamedTuple):
    """Triangles; normals and texture coordinates are per vertex."""

    vertices: NDArray[np.float32]
    """[V, 3], metres in the map frame."""
    normals: NDArray[np.float32]
    """[V, 3], unit."""
    texcoords: NDArray[np.float32]
    """(u, v), [V, 2]."""
    faces: NDArray[np.int32]
    """Vertex indices, [F, 3]."""


class _Quads:
    """Collects quads as (origin, first edge, second edge); their normal is first x second."""

    def __init__(self) -> None:
        self._corners: list[NDArray[np.float64]] = []
        self._texcoords: list[NDArray[np.float64]] = []

    def add(
        self,
        origin: NDArray[np.float64],
        first: NDArray[np.float64],
        second: NDArray[np.float64],
        u_end: NDArray[np.float64],
        v_range: tuple[float, float],
    ) -> None:
        """Add Q quads: origin, first, second [Q, 3]; u runs from 0 to `u_end` [Q] along `first`, v along `second`."""
        self._corners.append(np.stack([origin, origin + first, origin + first + second, origin + second], axis=1))
        u = np.stack([np.zeros_like(u_end), u_end, u_end, np.zeros_like(u_end)], axis=1)
        low, high = v_range
        v = np.broadcast_to(np.array([low, low, high, high]), u.shape)
        self._texcoords.append(np.stack([u, v], axis=-1))

    def mesh(self) -> Mesh:
        """Return the triangles of all quads."""
        # Shape [Q, 4, 3].
        corners = np.concatenate(self._corners)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        first = 4 * np.arange(len(corners))[:, None, None]
        faces = first + np.array([[0, 1, 2], [0, 2, 3]])
        return Mesh(
            corners.reshape(-1, 3).astype(np.float32),
            np.repeat(normal, 4, axis=0).astype(np.float32),
            np.concatenate(self._texcoords).reshape(-1, 2).astype(np.float32),
            faces.reshape(-1, 3).astype(np.int32),
        )


def _runs(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the maximal runs of true cells along the rows of a mask as (row, first column, end column), [R, 3]."""
    padded = np.pad(mask.astype(np.int8), ((0, 0), (1, 1)))
    step = np.diff(padded, axis=1)
    starts, ends = np.argwhere(step == 1), np.argwhere(step == -1)
    return np.concatenate([starts, ends[:, 1:]], axis=1)


def _ground_quads(quads: _Quads, mask: NDArray[np.bool_], z: float, v_range: tuple[float, float], cell: float) -> None:
    """Cover the true cells by horizontal strips at height z [m], seen from above."""
    runs = _runs(mask)
    corner = cell_to_xy(np.stack([runs[:, 0] + 0.5, runs[:, 1] - 0.5], axis=-1), cell)
    length = (runs[:, 2] - runs[:, 1]).astype(float)
    zero = np.zeros_like(length)
    quads.add(
        np.column_stack([corner, zero + z]),
        np.column_stack([length * cell, zero, zero]),
        np.column_stack([zero, zero + cell, zero]),
        length,
        v_range,
    )


def _wall_quads(
    quads: _Quads, wall: NDArray[np.bool_], height: float, v_range: tuple[float, float], cell: float
) -> None:
    """Add the wall sides, of a height in metres, that face free cells; runs along an axis are single quads."""
    # In a frame turned by k quarter turns every side is a south side: the cell below (next row) is free.
    for k in range(4):
        turned = np.rot90(wall, k)
        facing = np.zeros_like(turned)
        facing[:-1] = turned[:-1] & ~turned[1:]
        runs = _runs(facing)
        length = (runs[:, 2] - runs[:, 1]).astype(float)
        zero = np.zeros_like(length)
        corner = cell_to_xy(np.stack([runs[:, 0] + 0.5, runs[:, 1] - 0.5], axis=-1), cell)
        # np.rot90 turns counter-clockwise, so a clockwise turn takes points back to the map.
        cos, sin = (1, 0, -1, 0)[k], (0, -1, 0, 1)[k]
        x, y = corner[:, 0] * cos - corner[:, 1] * sin, corner[:, 0] * sin + corner[:, 1] * cos
        along = length * cell
        quads.add(
            np.column_stack([x, y, zero]),
            np.column_stack([along * cos, along * sin, zero]),
            np.column_stack([zero, zero, zero + height]),
            length,
            v_range,
        )


def _peg_quads(quads: _Quads, wall: NDArray[np.bool_], v_range: tuple[float, float], cell: float) -> None:
    """Add posts of square section, turned by 45 degrees, at the inner grid corners."""
    centre = cell_to_xy(peg_corners(wall) + 0.5, cell)
    zero = np.zeros(len(centre))
    r = PEG_HALF_DIAGONAL
    ring = np.array([[r, 0.0], [0.0, r], [-r, 0.0], [0.0, -r]])
    up = np.column_stack([zero, zero, zero + PEG_HEIGHT])
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        edge = np.broadcast_to(np.append(end - start, 0.0), (len(centre), 3))
        quads.add(np.column_stack([centre + start, zero]), edge, up, zero + 0.1, v_range)
    first = np.broadcast_to(np.append(ring[1] - ring[0], 0.0), (len(centre), 3))
    second = np.broadcast_to(np.append(ring[3] - ring[0], 0.0), (len(centre), 3))
    quads.add(np.column_stack([centre + ring[0], zero + PEG_HEIGHT]), first, second, zero + 0.1, v_range)


def level_mesh(
    wall: NDArray[np.bool_], cell_size: float, wall_height: float, band: Callable[[str], tuple[float, float]]
) -> Mesh:
    """Return floor, walls and pegs of a level as one mesh.

    Args:
        wall: wall cells, [N, N].
        cell_size: edge of a cell in metres.
        wall_height: height of drawn walls in cells.
        band: gives the range of v of a band of the atlas, see `BANDS`.
    """
    quads = _Quads()
    _ground_quads(quads, ~wall, 0.0, band("floor"), cell_size)
    _ground_quads(quads, wall, wall_height * cell_size, band("top"), cell_size)
    _wall_quads(quads, wall, wall_height * cell_size, band("side"), cell_size)
    _peg_quads(quads, wall, band("peg"), cell_size)
    return quads.mesh()


def skyline_mesh(cell_size: float) -> Mesh:
    """Return the rings that carry the skyline, seen from inside; u runs once around them, from east by north."""
    radius = SKYLINE_RADIUS * cell_size
    heights = (*SKYLINE_HEIGHTS, SKYLINE_HEIGHTS[-1], _SKY_TOP)
    angle = np.linspace(0.0, 2 * np.pi, _SKYLINE_SEGMENTS + 1)
    # Shape [rings, segments + 1].
    x = np.broadcast_to(radius * np.cos(angle), (len(heights), len(angle)))
    y = np.broadcast_to(radius * np.sin(angle), x.shape)
    z = np.broadcast_to(radius * np.array(heights)[:, None], x.shape)
    u = np.broadcast_to(angle / (2 * np.pi), x.shape)
    v = np.broadcast_to(np.array((*SKYLINE_V, _SKY_V, _SKY_V))[:, None], x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    normals = np.stack([-x / radius, -y / radius, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    index = np.arange(x.size).reshape(x.shape)
    # The ring at the texture's edge is there twice, with nothing in between.
    strips = np.flatnonzero(np.diff(heights))
    low, low_next = index[strips, :-1], index[strips, 1:]
    high, high_next = index[strips + 1, :-1], index[strips + 1, 1:]
    faces = np.stack(
        [np.stack([low, high, high_next], axis=-1), np.stack([low, high_next, low_next], axis=-1)], axis=-2
    )
    return Mesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32),
        faces.reshape(-1, 3).astype(np.int32),
    )
