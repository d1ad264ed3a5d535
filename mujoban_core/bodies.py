"""The robot's bodies: actuators, proprioception, scale and MJCF of each (paper appendix B, A.3).

The world never assumes a particular body: it reads what it needs from a `Body`. The robot's generalised
coordinates follow those of the boxes (see `mujoban_sim.scene`). A body's root is either

- ``"slides"``: slide joints x, y, z, then a hinge about z whose angle is the heading, then the inner joints; or
- ``"free"``: a free joint (position, quaternion), then the inner joints.

In both cases the first two coordinates are the position in the frame ``map`` in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.camera import CameraMount
from mujoban_core.grid import TIME_LIMIT

FIRST_PERSON_CAMERA: Final = "first_person"
"""Name of the camera that every body carries; it yields o_cam."""
ROBOT_BODY: Final = "robot"
"""Name of the MJCF body that carries root joints, camera and sensors."""

_SENSORS: Final = ("velocimeter", "gyro", "accelerometer")
"""Inertial sensors in the order of proprioception; each has three values in the robot's frame."""
INERTIAL_SIZE: Final = 3 * len(_SENSORS)
UP_AXIS_SIZE: Final = 3


@dataclass(frozen=True)
class Actuator:
    """A motor: normalised torque in [-1, 1] times `gear` [N m] on a joint."""

    joint: str
    gear: float


@dataclass(frozen=True)
class RobotPhysics:
    """Figures of a robot that differ between worlds; a body's MJCF names those that it has in braces.

    Attributes:
        head_mass: mass of all but the ball [kg].
        head_inertia: its moments of inertia about x, y and z [kg m^2].
        friction: sliding, torsional and rolling friction of the ball.
    """

    head_mass: float
    head_inertia: tuple[float, float, float]
    friction: tuple[float, float, float]


class ProprioSlices(NamedTuple):
    """Where what stands in proprioception o_pr, which has P = 12 + 2 J values for J inner joints."""

    linear_velocity: slice
    """Velocimeter, in the robot's frame [m/s], 3 values."""
    angular_velocity: slice
    """Gyro, in the robot's frame [rad/s], 3 values."""
    linear_acceleration: slice
    """Accelerometer, gravity included, in the robot's frame [m/s^2], 3 values."""
    joint_position: slice
    """Hinges wrapped to [-pi, pi] [rad], J values."""
    joint_velocity: slice
    """[rad/s], J values."""
    up_axis: slice
    """The world's z-axis in the robot's frame, 3 values."""
    size: int
    """P."""
    inertial: slice
    """The first three together."""
    planar_velocity: slice
    """Forwards and to the left, the first two values of `linear_velocity`."""
    yaw_rate: slice
    """About the robot's z-axis, the last value of `angular_velocity`."""

    @classmethod
    @cache
    def of(cls, joints: int) -> ProprioSlices:
        """Return the slices for a number of joints, J."""
        velocities = INERTIAL_SIZE + joints
        up_axis = velocities + joints
        return cls(
            linear_velocity=slice(0, 3),
            angular_velocity=slice(3, 6),
            linear_acceleration=slice(6, INERTIAL_SIZE),
            joint_position=slice(INERTIAL_SIZE, velocities),
            joint_velocity=slice(velocities, up_axis),
            up_axis=slice(up_axis, up_axis + UP_AXIS_SIZE),
            size=up_axis + UP_AXIS_SIZE,
            inertial=slice(0, INERTIAL_SIZE),
            planar_velocity=slice(0, 2),
            yaw_rate=slice(5, 6),
        )


@dataclass(frozen=True)
class Body:
    """Everything that depends on the robot's body.

    Attributes:
        name: key in `BODIES`.
        root: kind of root, see the module's docstring.
        joints: names of the J proprioceptive joints (hinges), in the order of proprioception.
        joint_qpos: their offsets among the robot's positions.
        joint_qvel: their offsets among the robot's velocities.
        actuators: motors in the order of the torque's U components.
        rest_qpos: the robot's positions when it stands at the map's origin and heads east; it settles from there.
        cell_size: edge of a cell in metres; the world is scaled by it, box mass and peg size are not (A.3).
        time_limit: steps of an episode at 20 Hz (240 s for the ball, 480 s for the ant).
        camera: how the body carries its first-person camera.
        mjcf: the ``<body>`` element, with the camera `FIRST_PERSON_CAMERA` and the site ``imu``; the figures of
            `RobotPhysics` stand in braces, for `fragment` to fill in.
    """

    name: str
    root: Literal["slides", "free"]
    joints: tuple[str, ...]
    joint_qpos: tuple[int, ...]
    joint_qvel: tuple[int, ...]
    actuators: tuple[Actuator, ...]
    rest_qpos: tuple[float, ...]
    cell_size: float
    time_limit: int
    camera: CameraMount
    mjcf: str

    @property
    def action_size(self) -> int:
        """U, the number of actuators."""
        return len(self.actuators)

    @property
    def proprio_size(self) -> int:
        """P, the number of proprioceptive values."""
        return self.proprio.size

    @cached_property
    def proprio(self) -> ProprioSlices:
        """Where what stands in proprioception."""
        return ProprioSlices.of(len(self.joints))

    @property
    def heading_index(self) -> int | None:
        """Where the heading stands in proprioception; None for a free root, which does not feel it."""
        return self.proprio.joint_position.start + self.joint_qpos.index(3) if self.root == "slides" else None

    @property
    def qpos_size(self) -> int:
        """Number of the robot's positions."""
        return len(self.rest_qpos)

    def set_pose(self, qpos: NDArray[np.float64], pose: NDArray[np.float64]) -> None:
        """Move the robot with positions `qpos` to a pose (x [m], y [m], psi [rad]); its height and posture stay."""
        qpos[:2] = pose[:2]
        if self.root == "slides":
            qpos[3] = pose[2]
        else:
            qpos[3:7] = (math.cos(pose[2] / 2), 0.0, 0.0, math.sin(pose[2] / 2))

    def fragment(self, physics: RobotPhysics) -> str:
        """Return the MJCF of the robot's bodies with a world's figures."""
        figures = {
            "head_mass": physics.head_mass,
            "head_inertia": " ".join(map(str, physics.head_inertia)),
            "friction": " ".join(map(str, physics.friction)),
        }
        return self.mjcf.format(**figures)

    @cached_property
    def actuator_mjcf(self) -> str:
        """The ``<actuator>`` section; controls are normalised torques in [-1, 1]."""
        motors = "".join(
            f'<motor name="{a.joint}" joint="{a.joint}" gear="{a.gear}" ctrllimited="true" ctrlrange="-1 1"/>'
            for a in self.actuators
        )
        return f"<actuator>{motors}</actuator>"

    @cached_property
    def sensor_mjcf(self) -> str:
        """The ``<sensor>`` section: the inertial sensors, in the order of proprioception."""
        return "<sensor>" + "".join(f'<{kind} site="imu"/>' for kind in _SENSORS) + "</sensor>"


# Two degrees of freedom: a steered head rolls on a ball, after the BoxHead walker of dm_control without its
# arms and kick. Gears and damping are measured choices: top speed 2 m/s without wheel spin. Low torsional
# friction, since a high one leaves a dead band of steering. The camera looks 6 degrees down from 0.85 m, which
# sees over boxes. Ears show the heading from above: red on the right, blue on the left.
_BALL_HEIGHT: Final = 0.6
_BALL_CAMERA: Final = CameraMount(forward=0.15, height=0.85, pitch=math.radians(6.0), fovy=80.0)
_BALL_MJCF: Final = f"""
<body name="{ROBOT_BODY}" pos="0 0 {_BALL_HEIGHT}">
  <joint name="x" type="slide" axis="1 0 0"/>
  <joint name="y" type="slide" axis="0 1 0"/>
  <joint name="z" type="slide" axis="0 0 1"/>
  <joint name="steer" type="hinge" axis="0 0 1" damping="4"/>
  <inertial pos="0 0 -0.08" mass="{{head_mass}}" diaginertia="{{head_inertia}}"/>
  <site name="imu" pos="0 0 0" size="0.01" group="4"/>
  <geom name="head" class="robot_visual" type="cylinder" size="0.1 0.06" pos="0 0 -0.07" rgba="0.3 0.3 0.3 1"/>
  <geom name="ear_red" class="robot_visual" type="sphere" size="0.1" pos="0 -0.2 0" rgba="0.7 0 0 1"/>
  <geom name="ear_blue" class="robot_visual" type="sphere" size="0.1" pos="0 0.2 0" rgba="0 0 0.7 1"/>
  {_BALL_CAMERA.mjcf(FIRST_PERSON_CAMERA, origin_height=_BALL_HEIGHT)}
  <body name="wheel" pos="0 0 -0.4">
    <joint name="roll" type="hinge" axis="0 1 0" damping="2"/>
    <geom name="ball" class="robot" type="sphere" size="0.2" mass="1" condim="4" friction="{{friction}}"
          rgba="0.6 0.6 0.6 1"/>
  </body>
</body>
"""

ROBOT_DEFAULTS: Final = """
<default class="robot"><geom contype="7" conaffinity="7"/></default>
<default class="robot_visual"><geom contype="0" conaffinity="0" mass="0"/></default>
"""
"""MJCF defaults that every body's fragment relies on; contact bits as in `mujoban_sim.scene`."""

BALL: Final = Body(
    name="ball",
    root="slides",
    joints=("roll", "steer"),
    joint_qpos=(4, 3),
    joint_qvel=(4, 3),
    actuators=(Actuator("roll", 20.0), Actuator("steer", 20.0)),
    rest_qpos=(0.0, 0.0, 0.0, 0.0, 0.0),
    cell_size=1.0,
    time_limit=TIME_LIMIT,
    camera=_BALL_CAMERA,
    mjcf=_BALL_MJCF,
)

BODIES: Final[dict[str, Body]] = {BALL.name: BALL}
"""Registry of bodies; add one and every environment, node and trainer accepts its name."""


def get_body(name: str) -> Body:
    """Return the body of a given name.

    Raises:
        ValueError: if there is none.
    """
    try:
        return BODIES[name]
    except KeyError:
        raise ValueError(f"unknown body {name!r}: expected one of {', '.join(sorted(BODIES))}") from None
