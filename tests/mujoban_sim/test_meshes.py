import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mujoban_core.grid import cell_to_xy, xy_to_cell
from mujoban_sim.appearance import Atlas
from mujoban_sim.meshes import MAX_QUADS, SKYLINE_HEIGHTS, SKYLINE_RADIUS, SKYLINE_ROWS, level_mesh, skyline_mesh
from mujoban_sim.scene import PEG_HEIGHT, peg_corners

BAND = Atlas(0.5).band_range


@st.composite
def walls(draw):
    wall = np.ones((10, 10), bool)
    bits = draw(st.lists(st.booleans(), min_size=64, max_size=64))
    wall[1:-1, 1:-1] = np.array(bits).reshape(8, 8)
    return wall


def triangles(mesh):
    corners = mesh.vertices[mesh.faces].astype(float)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners, cross, np.linalg.norm(cross, axis=-1) / 2


@given(walls(), st.sampled_from([1.0, 3.0]), st.sampled_from([0.5, 1.0]))
def test_floor_wall_tops_and_sides_have_the_area_of_the_level(wall, cell, wall_height):
    corners, cross, area = triangles(level_mesh(wall, cell, wall_height, BAND))
    horizontal, z = cross[:, 2] > 1e-9, corners[:, :, 2].mean(axis=1)
    height = wall_height * cell
    assert area[horizontal & (z == 0)].sum() == pytest.approx((~wall).sum() * cell**2)
    top = horizontal & np.isclose(z, height, atol=1e-6) & ~np.isclose(z, PEG_HEIGHT)
    assert area[top].sum() == pytest.approx(wall.sum() * cell**2)
    edges = (wall[1:] != wall[:-1]).sum() + (wall[:, 1:] != wall[:, :-1]).sum()
    sides = ~horizontal & (corners[:, :, 2].max(axis=1) > PEG_HEIGHT + 1e-6)
    assert area[sides].sum() == pytest.approx(edges * cell * height)


@given(walls())
def test_wall_sides_face_the_free_cell_before_them(wall):
    corners, cross, area = triangles(level_mesh(wall, 1.0, 0.5, BAND))
    sides = (cross[:, 2] == 0) & (corners[:, :, 2].max(axis=1) > PEG_HEIGHT + 1e-6)
    normal = (cross / (2 * area[:, None]))[sides]
    start = corners[sides].min(axis=1) + 0.25 * (1 - np.abs(normal)) * (0, 0, 1)
    # Half a cell from the start of a run is a cell's edge midpoint, half a cell along the normal its centre.
    along = 0.5 * (np.abs(normal[:, :2]) < 0.5)
    before = xy_to_cell(start[:, :2] + along + 0.5 * normal[:, :2])
    behind = xy_to_cell(start[:, :2] + along - 0.5 * normal[:, :2])
    assert not wall[tuple(before.T)].any()
    assert wall[tuple(behind.T)].all()


@given(walls())
def test_any_level_fits_in_the_capacity_and_its_normals_agree_with_its_windings(wall):
    mesh = level_mesh(wall, 1.0, 0.5, BAND)
    assert len(mesh.faces) <= 2 * MAX_QUADS
    assert len(mesh.vertices) <= 4 * MAX_QUADS
    _, cross, area = triangles(mesh)
    assert (area > 0).all()
    np.testing.assert_allclose(cross / (2 * area[:, None]), mesh.normals[mesh.faces[:, 0]], atol=1e-4)


def test_pegs_stand_turned_by_45_degrees_at_the_corners_of_cells():
    wall = np.ones((10, 10), bool)
    wall[1:-1, 1:-1] = False
    corners, cross, _ = triangles(level_mesh(wall, 1.0, 0.5, BAND))
    tops = corners[(cross[:, 2] > 0) & np.isclose(corners[:, :, 2].mean(axis=1), PEG_HEIGHT)].reshape(-1, 3)
    expected = {tuple(xy) for xy in cell_to_xy(peg_corners(wall) + 0.5)}
    assert len(expected) == 9 * 9 - 4
    assert expected == {tuple(xy) for xy in np.round(tops[:, :2])}
    offset = np.abs(tops[:, :2] - np.round(tops[:, :2]))
    np.testing.assert_allclose(np.sort(offset, axis=-1), np.broadcast_to([0.0, 0.05], offset.shape), atol=1e-6)


def test_the_skyline_faces_inwards():
    corners, cross, _ = triangles(skyline_mesh(1.0))
    assert (np.einsum("ij,ij->i", cross, corners.mean(axis=1) * (1, 1, 0)) < 0).all()


def test_above_the_skylines_texture_there_is_sky():
    mesh = skyline_mesh(1.0)
    corners, v = mesh.vertices[mesh.faces], mesh.texcoords[mesh.faces][..., 1]
    above = corners[..., 2].min(axis=1) > SKYLINE_HEIGHTS[-1] * SKYLINE_RADIUS - 1e-3
    assert corners[above][..., 2].max() > 2.0 * SKYLINE_RADIUS
    # The middle of the last row: its edge would show half of the first one.
    np.testing.assert_allclose(v[above], 1.0 - 0.5 / SKYLINE_ROWS)
