"""What a robot's body is: actuators, proprioception, scale and MJCF (paper appendix B, A.3).

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
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_core.camera import CameraMount

if TYPE_CHECKING:
    from torch import Tensor

Readings = TypeVar("Readings", NDArray[np.float32], "Tensor")

FIRST_PERSON_CAMERA: Final = "first_person"
"""Name of the camera that every body carries; it yields o_cam."""
ROBOT_BODY: Final = "robot"
"""Name of the MJCF body that carries root joints, camera and sensors."""

_SENSORS: Final = ("velocimeter", "gyro", "accelerometer")
"""Inertial sensors in the order of proprioception; each has three values in the robot's frame."""
INERTIAL_SIZE: Final = 3 * len(_SENSORS)
UP_AXIS_SIZE: Final = 3


@dataclass(frozen=True)
class Motor:
    """Takes a torque: its normalised control in [-1, 1] times `gear` [N m] acts on a joint."""

    joint: str
    gear: float

    @property
    def mjcf(self) -> str:
        """The actuator's element."""
        return (
            f'<motor name="{self.joint}" joint="{self.joint}" gear="{self.gear}" ctrllimited="true" ctrlrange="-1 1"/>'
        )


@dataclass(frozen=True)
class Servo:
    """Takes an angle: its normalised control in [-1, 1] is the position of a joint around `centre` that it holds.

    Attributes:
        joint: the joint.
        centre: position for control 0 [rad].
        span: how far from it control 1 is [rad].
        stiffness: torque for each radian that is left [N m / rad].
        damping: torque against each radian per second [N m s / rad].
        force: largest torque [N m].
    """

    joint: str
    centre: float
    span: float
    stiffness: float
    damping: float
    force: float

    @property
    def mjcf(self) -> str:
        """The actuator's element."""
        return (
            f'<general name="{self.joint}" joint="{self.joint}" ctrllimited="true" ctrlrange="-1 1" '
            f'forcelimited="true" forcerange="{-self.force} {self.force}" biastype="affine" '
            f'gainprm="{self.stiffness * self.span}" '
            f'biasprm="{self.stiffness * self.centre} {-self.stiffness} {-self.damping}"/>'
        )


Actuator = Motor | Servo


class Relabelling(NamedTuple):
    """How a body's joints, or its actuators, look after it was mirrored."""

    source: tuple[int, ...]
    """Entry i of the new order is entry `source[i]` of the body's own."""
    sign: tuple[float, ...]
    """Factor of each entry of the new order."""


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
        )

    def turn_rate(self, proprio: Readings) -> Readings:
        """Return the rate of turning about the vertical, however the robot leans, [...] rad/s, given o_pr, [..., P]."""
        rate = proprio[..., self.angular_velocity] * proprio[..., self.up_axis]
        return rate.sum(-1)  # pyright: ignore[reportReturnType] - of an array it is Any


@dataclass(frozen=True)
class Body:
    """Everything that depends on the robot's body.

    Attributes:
        name: key in `BODIES`.
        root: kind of root, see the module's docstring.
        joints: names of the J proprioceptive joints (hinges), in the order of proprioception.
        joint_qpos: their offsets among the robot's positions.
        joint_qvel: their offsets among the robot's velocities.
        joint_range: their lowest and highest positions [rad]; None for one that turns freely, whose position tells
            nothing of the posture.
        mirror: joints after a reflection at the robot's x-z plane.
        actuators: motors or servos in the order of the torque's U components.
        rest_qpos: the robot's positions when it stands at the map's origin and heads east; it settles from there.
        cell_size: edge of a cell in metres; the world is scaled by it, box mass and peg size are not (A.3).
        time_limit: steps of an episode at 20 Hz (240 s for the ball, 480 s for the ant).
        camera: how the body carries its first-person camera.
        mjcf: the ``<body>`` element, with the camera `FIRST_PERSON_CAMERA` and the site ``imu``; the figures of
            `RobotPhysics` stand in braces, for `fragment` to fill in.
        turn: the action, U values in [-1, 1], that turns it to its left on the spot; None where no single one does, and
            its controller learns to turn while it is told to stay.
        look_ticks: ticks in which it turns once; 0 where it does not, and then it does not look around by default.
        scripted: whether scripts that know the truth drive it, by torques (roll, steer); otherwise its oracle is its
            privileged teacher.
    """

    name: str
    root: Literal["slides", "free"]
    joints: tuple[str, ...]
    joint_qpos: tuple[int, ...]
    joint_qvel: tuple[int, ...]
    joint_range: tuple[tuple[float, float] | None, ...]
    mirror: Relabelling
    actuators: tuple[Actuator, ...]
    rest_qpos: tuple[float, ...]
    cell_size: float
    time_limit: int
    camera: CameraMount
    mjcf: str
    turn: tuple[float, ...] | None = None
    look_ticks: int = 0
    scripted: bool = False

    @property
    def action_size(self) -> int:
        """U, the number of actuators."""
        return len(self.actuators)

    @cached_property
    def actuated(self) -> tuple[str, ...]:
        """Names of the joints that actuators move, one for each of these."""
        return tuple(actuator.joint for actuator in self.actuators)

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
    def seeking_ticks(self) -> int:
        """Ticks of the look with which who has to find the heading by sight begins; 0 where it is felt."""
        return self.look_ticks if self.heading_index is None else 0

    @cached_property
    def mirrored_actuators(self) -> Relabelling:
        """Actuators after the reflection that `mirror` tells of joints."""
        source, sign = self.mirror
        joints = [self.joints.index(a.joint) for a in self.actuators]
        return Relabelling(tuple(joints.index(source[j]) for j in joints), tuple(sign[j] for j in joints))

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
        """The ``<actuator>`` section; controls are in [-1, 1]."""
        return f"<actuator>{''.join(a.mjcf for a in self.actuators)}</actuator>"

    @cached_property
    def sensor_mjcf(self) -> str:
        """The ``<sensor>`` section: the inertial sensors, in the order of proprioception."""
        return "<sensor>" + "".join(f'<{kind} site="imu"/>' for kind in _SENSORS) + "</sensor>"


ROBOT_DEFAULTS: Final = """
<default class="robot"><geom contype="0" conaffinity="7"/></default>
<default class="robot_visual"><geom contype="0" conaffinity="0" mass="0"/></default>
"""
"""MJCF defaults that every body's fragment relies on; contact bits as in `mujoban_sim.scene`. A robot touches all but
itself."""
