"""A body that only a description makes: nothing knows bodies by name."""

from __future__ import annotations

import dataclasses

from mujoban_core.bodies import ANT, Body, Motor, Relabelling

CART = Body(
    name="cart",
    root="free",
    joints=("left", "right"),
    joint_qpos=(7, 8),
    joint_qvel=(6, 7),
    joint_range=(None, None),
    mirror=Relabelling((1, 0), (1.0, 1.0)),
    actuators=(Motor("left", 0.5), Motor("right", 0.5)),
    rest_qpos=(0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    cell_size=0.5,
    time_limit=1000,
    camera=dataclasses.replace(ANT.camera, height=0.3),
    mjcf="""
    <body name="robot" pos="0 0 0.1"><freejoint name="root"/><site name="imu"/>
      <camera name="first_person" pos="0 0 0.2" xyaxes="0 -1 0 0 0 1"/>
      <geom class="robot" type="box" size="0.1 0.06 0.03" mass="3"/>
      <geom class="robot" type="sphere" size="0.05" pos="-0.08 0 -0.05" mass="0.1" friction="0.01 0.005 0.0001"/>
      <body name="left" pos="0 0.08 0"><joint name="left" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom class="robot" type="cylinder" size="0.1 0.01" euler="90 0 0" mass="0.2"/></body>
      <body name="right" pos="0 -0.08 0"><joint name="right" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom class="robot" type="cylinder" size="0.1 0.01" euler="90 0 0" mass="0.2"/></body>
    </body>""",
)
"""Two driven wheels and a caster."""
