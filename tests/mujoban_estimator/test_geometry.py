import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_core.bodies import BALL
from mujoban_core.camera import project
from mujoban_core.grid import GRID_SIZE, cell_to_xy
from mujoban_core.visibility import cells_in_view
from mujoban_estimator.geometry import CELLS, cell_geometry

poses = st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3.14, 3.14))


def box_in_open_room() -> np.ndarray:
    wall = np.ones((1, GRID_SIZE, GRID_SIZE), bool)
    wall[0, 1:-1, 1:-1] = False
    return wall


@given(poses)
@settings(max_examples=30)
def test_floor_anchors_are_where_the_camera_sees_the_cells(pose):
    geometry = cell_geometry(np.array([pose]), BALL.camera, 1.0)
    cells = np.stack(np.divmod(np.arange(CELLS), GRID_SIZE), -1)
    points = np.concatenate([cell_to_xy(cells), np.zeros((CELLS, 1))], -1)
    truth = project(points[None], np.array([pose]), BALL.camera)
    visible = geometry.visible[0, :, 0] > 0
    expected = (truth.pixels[0] + 0.5) / 32 - 1
    np.testing.assert_allclose(geometry.pixels[0, visible, 0], expected[visible], atol=1e-5)


@given(poses)
@settings(max_examples=30)
def test_turning_the_world_does_not_change_what_is_relative_to_the_robot(pose):
    x, y, psi = pose
    here = cell_geometry(np.array([[x, y, psi]]), BALL.camera, 1.0)
    turned = cell_geometry(np.array([[-y, x, psi + np.pi / 2]]), BALL.camera, 1.0)
    # A quarter turn to the left takes cell (row, col) to (9 - col, row).
    grid = here.pixels.reshape(GRID_SIZE, GRID_SIZE, -1)
    np.testing.assert_allclose(
        turned.pixels.reshape(GRID_SIZE, GRID_SIZE, -1), np.rot90(grid), atol=1e-4
    )


def test_a_larger_world_looks_the_same_up_to_the_height_of_the_camera():
    pose = np.array([[0.3, -1.2, 0.7]])
    small = cell_geometry(pose, BALL.camera, 1.0)
    large = cell_geometry(pose * [3, 3, 1], BALL.camera, 3.0)
    np.testing.assert_allclose(small.features, large.features, atol=1e-5)


def test_no_anchor_behind_the_robot_is_visible():
    geometry = cell_geometry(np.array([[0.5, 0.5, 0.0]]), BALL.camera, 1.0)
    behind = geometry.features[0, :, 0] * 4 < -1.0
    assert behind.any() and not geometry.visible[0, behind].any()


def test_walls_hide_what_is_behind_them():
    wall = box_in_open_room()
    wall[0, :, 6] = True
    seen = cells_in_view(wall, np.array([[-2.5, 0.5, 0.0]]), BALL.camera)
    assert seen[0, 4, 5] and seen[0, 4, 6] and not seen[0, :, 7:].any()


@pytest.mark.parametrize(("heading", "row", "col"), [(0.0, 4, 7), (np.pi / 2, 1, 4), (np.pi, 4, 1), (-np.pi / 2, 8, 4)])
def test_the_robot_sees_where_it_looks(heading, row, col):
    seen = cells_in_view(box_in_open_room(), np.array([[-0.5, 0.5, heading]]), BALL.camera)
    assert seen[0, row, col] and seen[0, 4, 4]
    opposite = {(4, 7): (4, 2), (1, 4): (7, 4), (4, 1): (4, 7), (8, 4): (2, 4)}[(row, col)]
    assert not seen[0, opposite[0], opposite[1]]
