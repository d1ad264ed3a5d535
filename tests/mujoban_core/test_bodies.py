import math

import mujoco
import numpy as np
import pytest

from mujoban_core.bodies import BALL, BODIES, FIRST_PERSON_CAMERA, INERTIAL_SIZE, get_body
from mujoban_sim.presets import EASED
from mujoban_sim.scene import scene_mjcf


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(scene_mjcf(np.zeros((10, 10), bool), 1, BALL, EASED))


def test_unknown_body_is_named_in_the_error():
    with pytest.raises(ValueError, match=r"'car'.*ball"):
        get_body("car")


@pytest.mark.parametrize("name", sorted(BODIES))
def test_a_body_describes_its_own_mjcf(name):
    body = BODIES[name]
    model = mujoco.MjModel.from_xml_string(scene_mjcf(np.zeros((10, 10), bool), 2, body, EASED))
    assert model.nu == body.action_size
    assert model.nq == 2 * 3 + body.qpos_size
    assert model.nsensordata == INERTIAL_SIZE
    assert [model.joint(model.actuator(a.joint).trnid[0]).name for a in body.actuators] == [
        a.joint for a in body.actuators
    ]
    for joint, qpos, qvel in zip(body.joints, body.joint_qpos, body.joint_qvel, strict=True):
        assert model.joint(joint).qposadr[0] == 2 * 3 + qpos
        assert model.joint(joint).dofadr[0] == 2 * 3 + qvel


def test_ball_camera_is_085_m_high_and_looks_6_degrees_down(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = model.camera(FIRST_PERSON_CAMERA).id
    assert data.cam_xpos[camera] == pytest.approx([0.15, 0.0, 0.85])
    axis = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
    assert math.degrees(math.asin(-axis[2])) == pytest.approx(6.0)
    assert axis[0] > 0.99
    assert model.cam_fovy[camera] == 80.0


def test_red_ear_is_on_the_robots_right(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    red, blue = model.geom("ear_red"), model.geom("ear_blue")
    assert data.geom_xpos[red.id][1] < 0 < data.geom_xpos[blue.id][1]
    assert red.rgba[0] > red.rgba[2] and blue.rgba[2] > blue.rgba[0]


def test_set_pose_keeps_height_and_posture():
    qpos = np.array([1.0, 2.0, 0.3, 0.4, 0.5])
    BALL.set_pose(qpos, np.array([-1.0, 3.0, 2.0]))
    assert qpos.tolist() == [-1.0, 3.0, 0.3, 2.0, 0.5]
