"""What nodes are made with: options of rclpy, and parameters with what `ros2 param describe` prints of them."""

from __future__ import annotations

from difflib import get_close_matches
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


def warn_of_unknown(node: Node) -> None:
    """Have a node that is made warn of parameters that it was given and has not, with the names that are near.

    They are not refused: a file may have some for all nodes (`/**`).
    """
    given: dict[str, Parameter] = node._parameter_overrides  # rclpy tells them nowhere else
    known = [*node._parameters]
    # Those that begin so are of rclpy itself, which reads them where it makes publishers and subscriptions.
    for name in sorted(name for name in given if name not in known and not name.startswith("qos_overrides.")):
        near = get_close_matches(name, known, 3) or known
        node.get_logger().warning(f"no parameter {name} of this node, which ignores it: expected {' or '.join(near)}")
