"""The ant body: a torso on four legs with eight degrees of freedom, in a world three times as large (paper A.3).

Geometry as in Gymnasium's ``Ant``, 6.0 kg: with its density of 5 it is too light to push a box. The limbs from torso
to hips are drawn alone: they weigh nothing and touch nothing. Servos hold the joints: with plain torques it learns
slower. Its legs pass through each other. Legs are numbered counter-clockwise, the first at the front on the left.
"""

from __future__ import annotations

import math
from typing import Final

from mujoban_core.bodies.body import FIRST_PERSON_CAMERA, ROBOT_BODY, Body, Relabelling, Servo
from mujoban_core.camera import CameraMount
from mujoban_core.grid import TIME_LIMIT

_HEIGHT: Final = 0.55
_DENSITY: Final = 40.0
_HIP_RANGE: Final = math.radians(30.0)
_ANKLE_RANGE: Final = (math.radians(30.0), math.radians(70.0))
_ANKLE_CENTRE: Final = math.radians(50.0)
_BEYOND: Final = math.radians(5.0)
"""How far beyond a joint's range servos reach, so that they push against the stop."""
_SERVO: Final = {"stiffness": 60.0, "damping": 2.0, "force": 40.0}
_SIDES: Final = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of x and y of each leg."""
# High enough to see over boxes and pitched so far down that the floor ahead stays in view when the robot tilts.
_CAMERA: Final = CameraMount(forward=0.0, height=1.6, pitch=math.radians(10.0), fovy=90.0)


def _leg(index: int, x: int, y: int) -> str:
    """Return a leg's bodies; a positive ankle bends the shin down."""
    limb = f'class="robot" type="capsule" size="0.08" density="{_DENSITY}" friction="1 0.005 0.0001"'
    joint = 'type="hinge" limited="true" armature="0.05" damping="0.5"'
    hip, (low, high) = math.degrees(_HIP_RANGE), (math.degrees(a) for a in _ANKLE_RANGE)
    return f"""
  <geom class="robot_visual" type="capsule" fromto="0 0 0 {0.2 * x} {0.2 * y} 0" size="0.08" rgba="0.6 0.6 0.6 1"/>
  <body name="leg{index}" pos="{0.2 * x} {0.2 * y} 0">
    <joint name="hip{index}" {joint} axis="0 0 1" range="{-hip} {hip}"/>
    <geom {limb} fromto="0 0 0 {0.2 * x} {0.2 * y} 0"/>
    <body name="shin{index}" pos="{0.2 * x} {0.2 * y} 0">
      <joint name="ankle{index}" {joint} axis="{-y} {x} 0" range="{low} {high}"/>
      <geom {limb} fromto="0 0 0 {0.4 * x} {0.4 * y} 0"/>
    </body>
  </body>"""


_MJCF: Final = f"""
<body name="{ROBOT_BODY}" pos="0 0 {_HEIGHT}">
  <freejoint name="root"/>
  <site name="imu" pos="0 0 0" size="0.01" group="4"/>
  <geom class="robot" name="torso" type="sphere" size="0.25" density="{_DENSITY}" rgba="0.6 0.6 0.6 1"/>
  <geom name="ear_red" class="robot_visual" type="sphere" size="0.12" pos="0 -0.2 0.2" rgba="0.7 0 0 1"/>
  <geom name="ear_blue" class="robot_visual" type="sphere" size="0.12" pos="0 0.2 0.2" rgba="0 0 0.7 1"/>
  {_CAMERA.mjcf(FIRST_PERSON_CAMERA, origin_height=_HEIGHT)}
  {"".join(_leg(i, *side) for i, side in enumerate(_SIDES))}
</body>
"""

_JOINTS: Final = tuple(f"{kind}{leg}" for leg in range(4) for kind in ("hip", "ankle"))

ANT: Final = Body(
    name="ant",
    root="free",
    joints=_JOINTS,
    joint_qpos=tuple(range(7, 15)),
    joint_qvel=tuple(range(6, 14)),
    joint_range=((-_HIP_RANGE, _HIP_RANGE), _ANKLE_RANGE) * 4,
    # Legs 0 and 3, 1 and 2 change places, and hips turn the other way.
    mirror=Relabelling((6, 7, 4, 5, 2, 3, 0, 1), (-1.0, 1.0) * 4),
    actuators=tuple(
        Servo(joint, 0.0, _HIP_RANGE + _BEYOND, **_SERVO)
        if joint.startswith("hip")
        else Servo(joint, _ANKLE_CENTRE, _ANKLE_RANGE[1] - _ANKLE_CENTRE + _BEYOND, **_SERVO)
        for joint in _JOINTS
    ),
    rest_qpos=(0.0, 0.0, _HEIGHT, 1.0, 0.0, 0.0, 0.0, *(0.0, _ANKLE_CENTRE) * 4),
    cell_size=3.0,
    time_limit=2 * TIME_LIMIT,
    camera=_CAMERA,
    mjcf=_MJCF,
    look_ticks=50,
)
