"""Where the robot's parts are, as tf and URDF say it: map -> base_link -> camera_link -> camera_optical_frame.

The messages of tf are no part of the ROS wheels, so only a ROS 2 that has `tf2_msgs` gets them; the description of the
robot is published everywhere.
"""

from __future__ import annotations

import math
from typing import Final

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, Quaternion, Transform, TransformStamped, Vector3
from std_msgs.msg import Header

from mujoban_core.bodies import Body
from mujoban_msgs_py import topics

_OPTICAL: Final = Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)
"""From x forward, y left, z up to x right, y down, z forward (REP 103)."""


def robot_transform(stamp: Time, pose: Pose) -> TransformStamped:
    """Return where the robot is: `base_link`, on the floor below its vertical axis, in `map`."""
    place = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    transform = Transform(translation=place, rotation=pose.orientation)
    header = Header(stamp=stamp, frame_id=topics.MAP_FRAME)
    return TransformStamped(header=header, child_frame_id=topics.BODY_FRAME, transform=transform)


def camera_transforms(body: Body) -> list[TransformStamped]:
    """Return how a body carries its camera: `camera_link` in `base_link`, `camera_optical_frame` in `camera_link`."""
    mount = body.camera
    place = Vector3(x=mount.forward, z=mount.height)
    tilt = Quaternion(y=math.sin(mount.pitch / 2), w=math.cos(mount.pitch / 2))
    return [
        _fixed(topics.BODY_FRAME, topics.CAMERA_LINK, Transform(translation=place, rotation=tilt)),
        _fixed(topics.CAMERA_LINK, topics.CAMERA_FRAME, Transform(rotation=_OPTICAL)),
    ]


def _fixed(parent: str, child: str, transform: Transform) -> TransformStamped:
    return TransformStamped(header=Header(frame_id=parent), child_frame_id=child, transform=transform)


def robot_description(body: Body) -> str:
    """Return the URDF of a body: a post on a ball and its camera, with the frames of tf."""
    mount = body.camera
    return f"""<?xml version="1.0"?>
<robot name="mujoban_{body.name}">
  <link name="{topics.BODY_FRAME}">
    <visual>
      <origin xyz="0 0 {mount.height / 2}"/>
      <geometry><cylinder radius="{0.2 * body.cell_size:g}" length="{mount.height}"/></geometry>
      <material name="robot"><color rgba="0.2 0.4 0.9 1"/></material>
    </visual>
  </link>
  <link name="{topics.CAMERA_LINK}"/>
  <link name="{topics.CAMERA_FRAME}"/>
  <joint name="camera" type="fixed">
    <parent link="{topics.BODY_FRAME}"/>
    <child link="{topics.CAMERA_LINK}"/>
    <origin xyz="{mount.forward} 0 {mount.height}" rpy="0 {mount.pitch} 0"/>
  </joint>
  <joint name="camera_optical" type="fixed">
    <parent link="{topics.CAMERA_LINK}"/>
    <child link="{topics.CAMERA_FRAME}"/>
    <origin rpy="{-math.pi / 2} 0 {-math.pi / 2}"/>
  </joint>
</robot>
"""
