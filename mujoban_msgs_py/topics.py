"""The one place for the graph's topics: names, types and QoS, and which symbol of the paper each carries.

All messages of a tick carry the same stamp: simulated time, which goes on over episodes, in steps of `TICK`.
rclpy is imported only when a QoS profile is asked for, so that readers of bags can do without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Protocol

from geometry_msgs.msg import PoseArray, PoseStamped, TwistStamped
from mujoban_msgs.msg import AbstractState, Episode, EpisodeTruth, Instruction, Proprioception, Termination
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Header

from mujoban_core.grid import CONTROL_PERIOD

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

TICK: Final = round(CONTROL_PERIOD * 1e9)
"""Nanoseconds of simulated time between two ticks."""
QUEUE_DEPTH: Final = 64
"""Messages kept for a slow reader: 3 s at 20 Hz. In lockstep a node is never more than a few ticks behind."""
LATCHED_DEPTH: Final = 8
"""Messages that a late joiner of a latched topic receives at most; the last one is the latest."""

MAP_FRAME: Final = "map"
CAMERA_FRAME: Final = "camera_optical_frame"
"""Optical frame of the robot's camera: x right, y down, z forward."""
TOP_CAMERA_FRAME: Final = "camera_top"
CAMERA_LINK: Final = "camera_link"
"""The robot's camera: x forward along its axis, y left, z up."""
BODY_FRAME: Final = "base_link"
"""The robot: on the floor below its vertical axis, x along its heading."""


class Message(Protocol):
    """A ROS message of whatever type."""

    SLOT_TYPES: Any
    """Of the fields in order: a tuple of what rosidl_parser describes them by."""

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return the type of each field by name."""
        ...


def type_name(kind: type[Any]) -> str:
    """Return the type of a message or service as ROS writes it, such as `sensor_msgs/msg/Image`."""
    package, family = kind.__module__.split(".")[:2]
    return f"{package}/{family}/{kind.__name__}"


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic of the graph."""

    name: str
    type: type[Message]
    latched: bool = False
    """Whether those who join late receive the latest message."""

    @property
    def type_name(self) -> str:
        """The type as ROS writes it, such as `sensor_msgs/msg/Image`."""
        return type_name(self.type)

    @property
    def depth(self) -> int:
        """Messages that are kept."""
        return LATCHED_DEPTH if self.latched else QUEUE_DEPTH

    @cached_property
    def qos(self) -> QoSProfile:
        """Reliable, and deep enough that nothing is lost in lockstep."""
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=self.depth,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.latched else DurabilityPolicy.VOLATILE,
        )


CAMERA: Final = Topic("/camera/image_raw", Image)
"""o_cam, rgb8."""
CAMERA_INFO: Final = Topic("/camera/camera_info", CameraInfo)
PROPRIO: Final = Topic("/proprio", Proprioception)
"""o_pr."""
POSE: Final = Topic("/pose", PoseStamped)
"""o_pos = (x, y, psi) in `MAP_FRAME`."""
EPISODE: Final = Topic("/episode", Episode, latched=True)
"""Start, number and end of the episode: all that modules may know of it."""
CLOCK: Final = Topic("/clock", Clock)
"""t."""
ABSTRACT_STATE: Final = Topic("/abstract_state", AbstractState)
"""The estimate of s_abst."""
TERMINATION: Final = Topic("/termination", Termination)
"""beta."""
INSTRUCTION: Final = Topic("/instruction", Instruction, latched=True)
"""A."""
TORQUE: Final = Topic("/torque", JointState)
"""a_tau, normalised to [-1, 1], in `effort`."""
TRUE_ABSTRACT_STATE: Final = Topic("/ground_truth/abstract_state", AbstractState)
"""s_abst."""
TRUE_POSE: Final = Topic("/ground_truth/pose", PoseStamped)
TRUE_TWIST: Final = Topic("/ground_truth/twist", TwistStamped)
"""Velocity in `MAP_FRAME`."""
TRUE_BOXES: Final = Topic("/ground_truth/boxes", PoseArray)
"""o_box."""
TRUE_TERMINATION: Final = Topic("/ground_truth/termination", Termination)
"""Whether A_{t-1} is completed by the rule of paper C.4."""
TRUE_EPISODE: Final = Topic("/ground_truth/episode", EpisodeTruth, latched=True)
"""Level, seed, reward, return and outcome of the episode."""
TOP_CAMERA: Final = Topic("/camera_top/image_raw", Image)
"""o_top, rgb8."""
RECORDED: Final = Topic("/recorded", Header)
"""The recorder has written the tick of this stamp."""
MONITORED: Final = Topic("/monitored", Header)
"""The monitor has heard the tick of this stamp, and what the modules decided in it."""

TRUTH_TOPICS: Final = (TRUE_ABSTRACT_STATE, TRUE_POSE, TRUE_TWIST, TRUE_BOXES, TRUE_TERMINATION, TRUE_EPISODE)
"""What only oracles and recorders receive."""
SIMULATOR_TOPICS: Final = (CLOCK, EPISODE, CAMERA, CAMERA_INFO, PROPRIO, POSE, *TRUTH_TOPICS, TOP_CAMERA)
"""What the simulator publishes."""
MODULE_TOPICS: Final = (ABSTRACT_STATE, TERMINATION, INSTRUCTION, TORQUE)
"""What the four modules publish, in the order of a tick."""
GRAPH_TOPICS: Final = {topic.name: topic for topic in (*SIMULATOR_TOPICS, *MODULE_TOPICS)}
"""Every topic worth recording, by name."""
PUBLISHERS: Final = {
    **{topic.name: "simulator" for topic in SIMULATOR_TOPICS},
    ABSTRACT_STATE.name: "estimator",
    TERMINATION.name: "termination",
    INSTRUCTION.name: "planner",
    TORQUE.name: "controller",
    RECORDED.name: "recorder",
    MONITORED.name: "monitor",
}
"""Topic -> name of the node that alone publishes on it."""
