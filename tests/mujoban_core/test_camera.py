import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mujoban_core.bodies import BALL, FIRST_PERSON_CAMERA, ROBOT_DEFAULTS
from mujoban_core.camera import camera_extrinsics, camera_intrinsics, in_view, project
from mujoban_sim.presets import EASED

poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-7, 7)).map(np.array)
points = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(0, 2)).map(np.array)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.5, -2.5, 2.0), (-3.2, 0.7, -1.1)])
def test_extrinsics_are_those_of_the_camera_that_the_body_carries(pose):
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><default>{ROBOT_DEFAULTS}</default><worldbody>{BALL.fragment(EASED.robot)}</worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[[0, 1, 3]] = pose
    mujoco.mj_forward(model, data)
    camera = model.camera(FIRST_PERSON_CAMERA).id
    # MuJoCo's camera looks along its -z with y up; the optical frame looks along +z with y down.
    rotation = data.cam_xmat[camera].reshape(3, 3).T * np.array([[1.0], [-1.0], [-1.0]])
    transform = camera_extrinsics(BALL.camera, pose)
    np.testing.assert_allclose(transform[:3, :3], rotation, atol=1e-6)
    np.testing.assert_allclose(transform[:3, 3], -rotation @ data.cam_xpos[camera], atol=1e-6)
    assert transform.shape == (4, 4) and transform[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert model.cam_fovy[camera] == BALL.camera.fovy


def test_the_intrinsics_are_those_of_a_frame_whose_pixels_have_whole_numbers_at_their_centres():
    # As ROS has it (sensor_msgs/CameraInfo): the edges of 64 pixels are at -0.5 and 63.5, half of 90 degrees from 31.5.
    found = camera_intrinsics(replace(BALL.camera, fovy=90.0), 64)
    np.testing.assert_allclose(found, [[32.0, 0.0, 31.5], [0.0, 32.0, 31.5], [0.0, 0.0, 1.0]])


@given(poses, points)
def test_a_point_that_projects_into_the_frame_is_in_view(pose, point):
    (pixel,), (depth,) = project(point[None], pose, BALL.camera, size=64)
    if depth > 0 and ((pixel > -0.5) & (pixel < 63.5)).all():
        assert in_view(point[None], 0.0, pose, BALL.camera).all()


@given(poses, points, st.floats(0.01, 1.0))
def test_a_sphere_is_in_view_when_a_point_of_it_is(pose, point, radius):
    offsets = np.random.default_rng(0).normal(size=(40, 3))
    offsets *= radius / np.linalg.norm(offsets, axis=-1, keepdims=True)
    if in_view(point + offsets, 0.0, pose, BALL.camera).any():
        assert in_view(point[None], radius, pose, BALL.camera).all()


def test_what_lies_on_the_optical_axis_appears_at_the_principal_point():
    mount = BALL.camera
    ahead = np.array([mount.forward + math.cos(mount.pitch), 0.0, mount.height - math.sin(mount.pitch)])
    (pixel,), (depth,) = project(ahead[None], np.zeros(3), mount, size=64)
    np.testing.assert_allclose(pixel, camera_intrinsics(mount, 64)[:2, 2])
    assert depth == pytest.approx(1.0)


def test_left_of_the_robot_is_left_in_the_frame_and_up_is_up():
    far_left, far_up = np.array([[3.0, 1.0, 0.85]]), np.array([[3.0, 0.0, 1.85]])
    centre = camera_intrinsics(BALL.camera, 64)[0, 2]
    assert project(far_left, np.zeros(3), BALL.camera).pixels[0, 0] < centre
    assert project(far_up, np.zeros(3), BALL.camera).pixels[0, 1] < centre


def test_a_batch_of_poses_projects_like_its_rows():
    rng = np.random.default_rng(0)
    pose, point = rng.normal(size=(5, 3)), rng.normal(size=(5, 7, 3))
    batch = project(point, pose, BALL.camera)
    for i in range(5):
        row = project(point[i], pose[i], BALL.camera)
        np.testing.assert_allclose(batch.pixels[i], row.pixels)
        np.testing.assert_allclose(batch.depth[i], row.depth)
