"""NumPy <-> message for every topic of the graph.

A function `x_to_msg` makes a message and `x_from_msg` reads one. Both check what passes: wrong shape, encoding or
size and values that are not finite raise `ConversionError`, so that nothing bad enters the graph or leaves it.
The readers take what rclpy delivers and what `rosbags` deserialises alike. Round trips are exact.

Array fields are filled with `array.array`: all else is 1,000 times slower. Scalars are Python's: NumPy's get corrupted.
A message makes its parts itself, also those that its constructor is given: so they are filled where they are. Numbers
are rounded to the field's type at once, so that a message that is handed over says what a serialised one does.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, TwistStamped
from mujoban_msgs.msg import AbstractState, Episode, EpisodeTruth, Instruction, Proprioception, Termination
from numpy.typing import ArrayLike, NDArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Header

from mujoban_core.bodies import BODIES, ProprioSlices
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import CHANNELS, DIFFICULTIES, GRID_SIZE
from mujoban_msgs_py.checks import ConversionError, check_probabilities, checked_direction, checked_probability, finite
from mujoban_msgs_py.topics import BODY_FRAME, Message

ENCODING: Final = "rgb8"
_SECOND: Final = 1_000_000_000
_ROUNDED_PI: Final = float(np.float32(math.pi))
_INERTIAL: Final = ("linear_velocity", "angular_velocity", "linear_acceleration")


# Time


def time_to_msg(stamp: int) -> Time:
    """Return a time given in nanoseconds."""
    return Time(sec=stamp // _SECOND, nanosec=stamp % _SECOND)


def time_from_msg(message: Time) -> int:
    """Return a time in nanoseconds."""
    return message.sec * _SECOND + message.nanosec


def header(stamp: int, frame_id: str = "") -> Header:
    """Return a header for a stamp in nanoseconds."""
    return Header(stamp=time_to_msg(stamp), frame_id=frame_id)


def stamp_of(message: Message | Header) -> int:
    """Return the stamp of a message with a header, of a header or of a clock, in nanoseconds."""
    stamped: Any = getattr(message, "header", message)
    return time_from_msg(stamped.stamp if hasattr(stamped, "stamp") else stamped.clock)


def clock_to_msg(stamp: int) -> Clock:
    """Return t."""
    return Clock(clock=time_to_msg(stamp))


# Observations


def frame_to_msg(header: Header, frame: NDArray[np.uint8]) -> Image:
    """Return an image of RGB pixels, uint8 [H, W, 3]."""
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ConversionError(f"frame must be uint8 [H, W, 3], got {frame.dtype} {list(frame.shape)}")
    height, width, _ = frame.shape
    data = array("B", frame.tobytes())
    return Image(header=header, height=height, width=width, encoding=ENCODING, step=3 * width, data=data)


def frame_from_msg(message: Image, size: int | None = FRAME_SIZE) -> NDArray[np.uint8]:
    """Return the pixels of an rgb8 image, [H, W, 3]; H = W = `size` unless that is None."""
    if message.encoding != ENCODING:
        raise ConversionError(f"image encoding must be {ENCODING!r}, got {message.encoding!r}")
    height, width, step = message.height, message.width, message.step
    if size is not None and (height, width) != (size, size):
        raise ConversionError(f"image must be {size}x{size} pixels, got {width}x{height}")
    if not (height and width):
        raise ConversionError(f"image must have a pixel or more, got {width}x{height}")
    data = np.frombuffer(message.data, np.uint8)
    if step < 3 * width or data.size != step * height:
        raise ConversionError(
            f"image of {width}x{height} pixels with rows of {step} bytes must have {step * height} bytes "
            f"and at least {3 * width} to the row, got {data.size}"
        )
    return data.reshape(height, step)[:, : 3 * width].reshape(height, width, 3)


def camera_info_to_msg(header: Header, intrinsics: ArrayLike, size: int = FRAME_SIZE) -> CameraInfo:
    """Return the calibration of a square pinhole camera with intrinsic matrix K, [3, 3]."""
    k = finite("intrinsics", intrinsics, (3, 3), np.float64)
    projection = np.hstack([k, np.zeros((3, 1))])
    return CameraInfo(
        header=header,
        height=size,
        width=size,
        distortion_model="plumb_bob",
        d=array("d", [0.0] * 5),
        k=k.ravel(),
        r=np.eye(3).ravel(),
        p=projection.ravel(),
    )


def camera_info_from_msg(message: CameraInfo) -> NDArray[np.float64]:
    """Return the intrinsic matrix K, [3, 3]."""
    return finite("k", message.k, (9,), np.float64).reshape(3, 3)


def proprio_to_msg(header: Header, proprio: ArrayLike, joints: Sequence[str]) -> Proprioception:
    """Return o_pr, [P], in the layout of `mujoban_core.bodies.ProprioSlices`, of a body with these joints."""
    part = ProprioSlices.of(len(joints))
    values = finite("proprio", proprio, (part.size,), np.float64).tolist()
    message = Proprioception(
        header=header,
        name=list(joints),
        position=array("d", values[part.joint_position]),
        velocity=array("d", values[part.joint_velocity]),
    )
    parts = (part.linear_velocity, part.angular_velocity, part.linear_acceleration, part.up_axis)
    for name, where in zip((*_INERTIAL, "world_z_axis"), parts, strict=True):
        vector = getattr(message, name)
        vector.x, vector.y, vector.z = values[where]
    return message


def proprio_from_msg(message: Proprioception) -> NDArray[np.float32]:
    """Return o_pr, [P], in the layout of `mujoban_core.bodies.ProprioSlices`."""
    count = len(message.name)
    if not len(message.position) == len(message.velocity) == count:
        raise ConversionError(
            f"proprioception of {count} joints must have as many positions and velocities, "
            f"got {len(message.position)} and {len(message.velocity)}"
        )
    values = [c for field in _INERTIAL for v in (getattr(message, field),) for c in (v.x, v.y, v.z)]
    axis = message.world_z_axis
    values += [*message.position, *message.velocity, axis.x, axis.y, axis.z]
    return finite("proprioception", values, (ProprioSlices.of(count).size,), np.float32)


def body_proprio_from_msg(message: Proprioception) -> NDArray[np.float32]:
    """Return o_pr, [P], of one of `mujoban_core.bodies.BODIES`."""
    if tuple(message.name) not in {body.joints for body in BODIES.values()}:
        known = "; ".join(f"{', '.join(body.joints)} ({name})" for name, body in BODIES.items())
        raise ConversionError(f"joints must be those of a body, {known}, got {', '.join(message.name)[:80]!r}")
    return proprio_from_msg(message)


def pose_to_msg(header: Header, pose: ArrayLike) -> PoseStamped:
    """Return a pose (x [m], y [m], psi [rad]), [3]; psi in [-pi, pi]."""
    x, y, yaw = finite("pose", pose, (3,), np.float64).tolist()
    message = PoseStamped(header=header)
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, q.z, q.w = x, y, math.sin(yaw / 2), math.cos(yaw / 2)
    return message


def pose_from_msg(message: PoseStamped) -> NDArray[np.float32]:
    """Return (x [m], y [m], psi [rad]), [3]; psi in [-pi, pi], as far as float32 has these bounds."""
    p, q = message.pose.position, message.pose.orientation
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not abs(norm - 1.0) < 1e-3:
        raise ConversionError(f"orientation must be a unit quaternion, got ({q.x}, {q.y}, {q.z}, {q.w})")
    if q.x == q.y == 0.0 and abs(half := math.atan2(q.z, q.w)) < _ROUNDED_PI / 2 + 1e-9:
        # Exact for a robot that stands upright, also at -pi and pi as float32 rounds them: just outside [-pi, pi].
        yaw = 2 * half
    else:
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return finite("pose", (p.x, p.y, yaw), (3,), np.float32)


# What the modules say


def abstract_state_to_msg(header: Header, state: NDArray[np.floating[Any]]) -> AbstractState:
    """Return s_abst or an estimate of it, probabilities [rows, columns, 4]."""
    # Shape [4, rows, columns].
    layers = np.moveaxis(abstract_state_value(state), 2, 0)
    fields = {name: array("f", layer.tobytes()) for name, layer in zip(CHANNELS, layers, strict=True)}
    return AbstractState(header=header, rows=state.shape[0], cols=state.shape[1], **fields)


def abstract_state_value(state: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return a copy of s_abst or of an estimate of it as its message carries it."""
    if state.ndim != 3 or state.shape[2] != len(CHANNELS):
        raise ConversionError(f"abstract state must be [rows, columns, {len(CHANNELS)}], got {list(state.shape)}")
    check_probabilities("abstract state", state)
    return state.astype(np.float32)


def abstract_state_from_msg(message: AbstractState) -> NDArray[np.float32]:
    """Return probabilities [N, N, 4], N = `grid.GRID_SIZE`."""
    rows, cols = message.rows, message.cols
    if (rows, cols) != (GRID_SIZE, GRID_SIZE):
        raise ConversionError(f"abstract state must have {GRID_SIZE}x{GRID_SIZE} cells, got {rows}x{cols}")
    state = np.empty((rows, cols, len(CHANNELS)), np.float32)
    for channel, name in enumerate(CHANNELS):
        layer = np.frombuffer(getattr(message, name), np.float32)
        if layer.size != rows * cols:
            raise ConversionError(f"layer {name!r} of {rows}x{cols} cells must have {rows * cols}, got {layer.size}")
        state[..., channel] = layer.reshape(rows, cols)
    check_probabilities("abstract state", state)
    return state


class InstructionReading(NamedTuple):
    """A, as read from a message."""

    sequence: int
    direction: int


def instruction_value(sequence: int, direction: int) -> InstructionReading:
    """Return A and its number in the episode as their message carries them."""
    return InstructionReading(int(sequence), checked_direction(direction))


def instruction_to_msg(header: Header, reading: InstructionReading) -> Instruction:
    """Return A and its number in the episode."""
    sequence, direction = instruction_value(*reading)
    return Instruction(header=header, sequence=sequence, direction=direction)


def instruction_from_msg(message: Instruction) -> InstructionReading:
    """Return A and its number in the episode."""
    return InstructionReading(message.sequence, checked_direction(message.direction))


class TerminationReading(NamedTuple):
    """beta, as read from a message."""

    sequence: int
    probability: float
    terminated: bool
    timed_out: bool


def termination_value(
    sequence: int, probability: float, terminated: bool, timed_out: bool = False
) -> TerminationReading:
    """Return beta, which is about the instruction of number `sequence`, as its message carries it."""
    rounded = float(np.float32(checked_probability(probability)))
    return TerminationReading(int(sequence), rounded, bool(terminated), bool(timed_out))


def termination_to_msg(header: Header, reading: TerminationReading) -> Termination:
    """Return beta, its probability and what it is about."""
    return Termination(header=header, **termination_value(*reading)._asdict())


def termination_from_msg(message: Termination) -> TerminationReading:
    """Return beta, its probability and what it is about."""
    return TerminationReading(
        message.sequence, checked_probability(message.probability), bool(message.terminated), bool(message.timed_out)
    )


def torque_to_msg(header: Header, torque: ArrayLike, joints: Sequence[str] = ()) -> JointState:
    """Return torques normalised to [-1, 1], [U], of the joints that actuators move; they are in the robot's frame."""
    values = torque_value(torque).astype(np.float64)
    header = Header(stamp=header.stamp, frame_id=BODY_FRAME)
    return JointState(header=header, name=list(joints), effort=array("d", values.tobytes()))


def torque_value(torque: ArrayLike) -> NDArray[np.float32]:
    """Return a copy of torques normalised to [-1, 1], [U], as their message carries them."""
    values = finite("torque", torque, (None,), np.float32)
    if not all(-1.0 <= value <= 1.0 for value in values.tolist()):
        raise ConversionError(f"torque must lie in [-1, 1], got {values.tolist()}")
    return values


def torque_from_msg(message: JointState) -> NDArray[np.float32]:
    """Return torques normalised to [-1, 1], [U]."""
    return torque_value(message.effort)


# Ground truth


def twist_to_msg(header: Header, velocity: ArrayLike) -> TwistStamped:
    """Return (vx [m/s], vy [m/s], yaw rate [rad/s]) in the map frame, [3]."""
    vx, vy, rate = finite("velocity", velocity, (3,), np.float64).tolist()
    message = TwistStamped(header=header)
    message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = vx, vy, rate
    return message


def twist_from_msg(message: TwistStamped) -> NDArray[np.float32]:
    """Return (vx [m/s], vy [m/s], yaw rate [rad/s]) in the map frame, [3]."""
    linear, angular = message.twist.linear, message.twist.angular
    return finite("velocity", (linear.x, linear.y, angular.z), (3,), np.float32)


def boxes_to_msg(header: Header, position: ArrayLike) -> PoseArray:
    """Return o_box, box centres in the map frame [m], [K, 2]; boxes never turn."""
    centres = finite("box positions", position, (None, 2), np.float64).tolist()
    return PoseArray(header=header, poses=[Pose(position=Point(x=x, y=y)) for x, y in centres])


def boxes_from_msg(message: PoseArray) -> NDArray[np.float32]:
    """Return o_box, box centres in the map frame [m], [K, 2]."""
    centres = np.array([(p.position.x, p.position.y) for p in message.poses], np.float64).reshape(-1, 2)
    return finite("box positions", centres, (None, 2), np.float32)


class EpisodeReading(NamedTuple):
    """Start, number and end of an episode; the fields are those of `mujoban_msgs/msg/Episode`."""

    episode: int
    step: int
    ended: bool


def episode_to_msg(header: Header, reading: EpisodeReading) -> Episode:
    """Return what every node may know of an episode."""
    return Episode(header=header, episode=int(reading.episode), step=int(reading.step), ended=bool(reading.ended))


def episode_from_msg(message: Episode) -> EpisodeReading:
    """Return what every node may know of an episode."""
    return EpisodeReading(message.episode, message.step, message.ended)


class EpisodeTruthReading(NamedTuple):
    """Level, reward and outcome of an episode; the fields are those of `mujoban_msgs/msg/EpisodeTruth`."""

    episode: int
    seed: int
    difficulty: int
    level: str
    step: int
    reward: float
    episode_return: float
    solved: bool
    terminated: bool
    truncated: bool
    boxes_on_target: int


def episode_truth_value(reading: EpisodeTruthReading) -> EpisodeTruthReading:
    """Return the truth about an episode as its message carries it."""
    reward, total = finite("reward and return", (reading.reward, reading.episode_return), (2,), np.float32).tolist()
    return EpisodeTruthReading(
        episode=int(reading.episode),
        seed=int(reading.seed),
        difficulty=int(reading.difficulty),
        level=reading.level,
        step=int(reading.step),
        reward=reward,
        episode_return=total,
        solved=bool(reading.solved),
        terminated=bool(reading.terminated),
        truncated=bool(reading.truncated),
        boxes_on_target=int(reading.boxes_on_target),
    )


def episode_truth_to_msg(header: Header, reading: EpisodeTruthReading) -> EpisodeTruth:
    """Return the truth about an episode."""
    return EpisodeTruth(header=header, **episode_truth_value(reading)._asdict())


def episode_truth_from_msg(message: EpisodeTruth) -> EpisodeTruthReading:
    """Return the truth about an episode."""
    reading = EpisodeTruthReading(*(getattr(message, name) for name in EpisodeTruthReading._fields))
    finite("reward and return", (reading.reward, reading.episode_return), (2,), np.float64)
    if reading.difficulty not in (0, *DIFFICULTIES):
        raise ConversionError(f"difficulty must be 0 or one of {sorted(DIFFICULTIES)}, got {reading.difficulty}")
    return reading
