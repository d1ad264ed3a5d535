"""The ball body: two degrees of freedom, a steered head that rolls on a ball (paper appendix B)."""

from __future__ import annotations

import math
from typing import Final

from mujoban_core.bodies.body import FIRST_PERSON_CAMERA, ROBOT_BODY, Body, Motor, Relabelling
from mujoban_core.camera import CameraMount
from mujoban_core.grid import TIME_LIMIT

# Two degrees of freedom: a steered head rolls on a ball, after the BoxHead walker of dm_control without its
# arms and kick. Gears and damping are measured choices: top speed 2 m/s without wheel spin. Low torsional
# friction, since a high one leaves a dead band of steering. The camera looks 6 degrees down from 0.85 m, which
# sees over boxes. Ears show the heading from above: red on the right, blue on the left.
_HEIGHT: Final = 0.6
_CAMERA: Final = CameraMount(forward=0.15, height=0.85, pitch=math.radians(6.0), fovy=80.0)
_MJCF: Final = f"""
<body name="{ROBOT_BODY}" pos="0 0 {_HEIGHT}">
  <joint name="x" type="slide" axis="1 0 0"/>
  <joint name="y" type="slide" axis="0 1 0"/>
  <joint name="z" type="slide" axis="0 0 1"/>
  <joint name="steer" type="hinge" axis="0 0 1" damping="4"/>
  <inertial pos="0 0 -0.08" mass="{{head_mass}}" diaginertia="{{head_inertia}}"/>
  <site name="imu" pos="0 0 0" size="0.01" group="4"/>
  <geom name="head" class="robot_visual" type="cylinder" size="0.1 0.06" pos="0 0 -0.07" rgba="0.3 0.3 0.3 1"/>
  <geom name="ear_red" class="robot_visual" type="sphere" size="0.1" pos="0 -0.2 0" rgba="0.7 0 0 1"/>
  <geom name="ear_blue" class="robot_visual" type="sphere" size="0.1" pos="0 0.2 0" rgba="0 0 0.7 1"/>
  {_CAMERA.mjcf(FIRST_PERSON_CAMERA, origin_height=_HEIGHT)}
  <body name="wheel" pos="0 0 -0.4">
    <joint name="roll" type="hinge" axis="0 1 0" damping="2"/>
    <geom name="ball" class="robot" type="sphere" size="0.2" mass="1" condim="4" friction="{{friction}}"
          rgba="0.6 0.6 0.6 1"/>
  </body>
</body>
"""

BALL: Final = Body(
    name="ball",
    root="slides",
    joints=("roll", "steer"),
    joint_qpos=(4, 3),
    joint_qvel=(4, 3),
    joint_range=(None, None),
    mirror=Relabelling((0, 1), (1.0, -1.0)),
    actuators=(Motor("roll", 20.0), Motor("steer", 20.0)),
    rest_qpos=(0.0, 0.0, 0.0, 0.0, 0.0),
    cell_size=1.0,
    time_limit=TIME_LIMIT,
    camera=_CAMERA,
    mjcf=_MJCF,
    turn=(0.0, 0.7),
    look_ticks=58,
    scripted=True,
)
