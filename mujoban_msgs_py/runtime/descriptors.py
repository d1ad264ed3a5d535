"""What nodes are made with: options of rclpy, and parameters with what `ros2 param describe` prints of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict, TypeVar, cast

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from mujoban_msgs_py.run_identifier import ANY
from mujoban_msgs_py.topics import TICK

if TYPE_CHECKING:
    from mujoban_msgs_py.runtime.intra_process import IntraProcess

ValueT = TypeVar("ValueT", bool, int, float, str)


class RclpyOptions(TypedDict, total=False):
    """The options of rclpy's `Node` that nodes here are made with."""

    context: Context | None
    parameter_overrides: list[Parameter]


class NodeOptions(RclpyOptions, total=False):
    """What nodes here are made with."""

    intra_process: IntraProcess | None
    """Hands over messages between nodes of this process; None: all go through the middleware."""


def described(
    text: str, *, fixed: bool = False, low: float | None = None, high: float | None = None
) -> ParameterDescriptor:
    """Return the descriptor of a parameter.

    Args:
        text: What it means.
        fixed: Whether it is given when the node starts and stays as it is.
        low: Least value; of its type is the parameter.
        high: Greatest value; of the same type.
    """
    descriptor = ParameterDescriptor(description=text, read_only=fixed)
    if low is None or high is None:
        return descriptor
    if isinstance(low, int) and isinstance(high, int):
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor


def declare(node: Node, name: str, default: ValueT, descriptor: ParameterDescriptor) -> ValueT:
    """Declare a parameter of a node and return its value, which rclpy keeps of the default's type.

    Raises:
        ParameterException: If it was given a value of another type, or out of its range.
    """
    return cast(ValueT, node.declare_parameter(name, default, descriptor).value)


def declare_run(node: Node, default: int = ANY) -> int:
    """Declare the parameter `run` of a node and return the identifier of the run that it belongs to.

    Raises:
        ParameterException: If it is out of its range; `ANY` is in it where that is the default.
    """
    about = described("identifier of the run; -1: of any", fixed=True, low=min(default, 0), high=TICK - 1)
    return declare(node, "run", default, about)
