"""Descriptors of the nodes' parameters: what `ros2 param describe` prints, and the range that a value must lie in."""

from __future__ import annotations

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor


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
