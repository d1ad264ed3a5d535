"""The frames of tf and URDF are those by which the camera's geometry projects."""

import json
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time

from bringup import viz
from bringup.frames import camera_transforms, robot_description, robot_transform
from mujoban_core.bodies import BALL
from mujoban_core.camera import camera_extrinsics
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.listening import Received

CONFIG = Path(viz.__file__).parent / "config"


def matrix(transform):
    """Return a transform as a homogeneous matrix, child to parent."""
    t, q = transform.transform.translation, transform.transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), t.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), t.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), t.z],
            [0, 0, 0, 1],
        ]
    )


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.5, -2.5, 0.7), (-3.0, 4.0, -3.0)])
def test_the_chain_of_transforms_leads_to_where_the_camera_projects_from(pose):
    message = conversions.pose_to_msg(conversions.header(1), pose)
    chain = [robot_transform(Time(), message.pose), *camera_transforms(BALL)]
    assert [t.header.frame_id for t in chain] == ["map", "base_link", "camera_link"]
    assert [t.child_frame_id for t in chain] == ["base_link", "camera_link", "camera_optical_frame"]
    to_map = np.linalg.multi_dot([matrix(t) for t in chain])
    np.testing.assert_allclose(np.linalg.inv(to_map), camera_extrinsics(BALL.camera, pose), atol=1e-6)


def test_the_description_has_the_same_frames():
    root = ElementTree.fromstring(robot_description(BALL))
    assert [link.get("name") for link in root.iter("link")] == ["base_link", "camera_link", "camera_optical_frame"]
    origin = root.find("joint[@name='camera']/origin").get("xyz").split()
    assert [float(x) for x in origin] == [BALL.camera.forward, 0.0, BALL.camera.height]


def test_layouts_name_topics_that_there_are():
    rviz = yaml.safe_load((CONFIG / "mujoban.rviz").read_text())["Visualization Manager"]["Displays"]
    shown = {(d.get("Topic") or d.get("Description Topic") or {}).get("Value") for d in rviz} - {None}
    foxglove = json.loads((CONFIG / "mujoban.foxglove.json").read_text())["configById"]
    shown |= set(foxglove["3D!scene"]["topics"]) | {foxglove["Image!robot"]["imageMode"]["imageTopic"]}
    known = {"/camera/image_raw", "/robot_description", "/viz/scene"}
    known |= {f"/viz/{source}/{layer}" for source in ("estimate", "ground_truth") for layer in viz.CHANNELS}
    assert shown <= known and len(shown) >= 5


def test_a_tick_that_is_offered_again_is_no_new_transform(ros):
    node, sent = viz.VizNode(), []
    node._tf, node._make_tf = SimpleNamespace(publish=sent.append), SimpleNamespace
    for tick in (1, 2, 2, 3, 3, 1):  # time may jump back
        pose = conversions.pose_to_msg(conversions.header(tick * topics.TICK), (1.0, 0.0, 0.0))
        node._on_pose(Received(tick * topics.TICK, pose, b""))
    assert [conversions.stamp_of(said.transforms[0]) // topics.TICK for said in sent] == [1, 2, 3, 1]
    node.destroy_node()
