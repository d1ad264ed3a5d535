"""Messages as YAML and CSV, and from YAML."""

from __future__ import annotations

import array
import re
from typing import Any, Final, TypeGuard

import numpy as np
import yaml
from builtin_interfaces.msg import Time
from rosidl_parser.definition import AbstractNestedType, Array, BasicType, BoundedSequence, NamespacedType

from mujoban_msgs_py.ros2.session import CommandError, import_type
from mujoban_msgs_py.topics import Message

_SEQUENCE: Final = re.compile(r"^sequence<(?P<element>.+?)(?:,\s*\d+)?>$|^(?P<fixed>.+)\[\d+\]$")
_FLOATS: Final = ("float", "double")


def is_message(value: object) -> TypeGuard[Message]:
    """Return whether a value is a ROS message."""
    return hasattr(value, "get_fields_and_field_types")


def to_yaml(
    message: Message,
    *,
    truncate: int | None = 128,
    no_arr: bool = False,
    no_str: bool = False,
    flow_style: bool = False,
) -> str:
    """Return a message as YAML.

    Args:
        message: The message.
        truncate: Elements of an array and letters of a string that are shown; None shows all.
        no_arr: Whether arrays are described instead of shown.
        no_str: Whether strings are described instead of shown.
        flow_style: Whether all of it goes on one line.
    """
    plain = _plain(message, None, truncate, no_arr, no_str)
    return yaml.safe_dump(
        plain, sort_keys=False, allow_unicode=True, width=float("inf"), default_flow_style=flow_style
    )


def to_csv(message: object, *, truncate: int | None = 128, no_arr: bool = False, no_str: bool = False) -> str:
    """Return a message as one line of comma-separated values."""
    return ",".join(str(leaf) for leaf in _leaves(_plain(message, None, truncate, no_arr, no_str)))


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [leaf for item in value.values() for leaf in _leaves(item)]
    if isinstance(value, list):
        return [leaf for item in value for leaf in _leaves(item)]
    return [value]


def _plain(value: Any, kind: object, truncate: int | None, no_arr: bool, no_str: bool) -> Any:
    """Return a value as dictionaries, lists and scalars."""
    if is_message(value):
        kinds = zip(value.get_fields_and_field_types(), value.SLOT_TYPES, strict=True)
        return {name: _plain(getattr(value, name), kind, truncate, no_arr, no_str) for name, kind in kinds}
    if isinstance(value, list | tuple | array.array | np.ndarray):
        if no_arr and isinstance(kind, AbstractNestedType):
            return _described(kind, len(value))
        shown = value if truncate is None else value[:truncate]
        items = [_plain(item, kind, truncate, no_arr, no_str) for item in shown]
        return items if len(shown) == len(value) else [*items, "..."]
    if isinstance(value, str):
        if no_str:
            return f"<string length: <{len(value)}>>"
        return value if truncate is None or len(value) <= truncate else value[:truncate] + "..."
    if isinstance(value, bytes):
        return list(value)
    return value.item() if isinstance(value, np.generic) else value


def _described(kind: AbstractNestedType, length: int) -> str:
    """Return what the genuine command prints in the place of an array."""
    match kind.value_type:
        case BasicType() as element:
            name = element.typename
        case NamespacedType() as element:
            name = "/".join(element.namespaced_name())
        case _:
            name = "string"
    if isinstance(kind, Array):
        return f"<array type: {name}[{kind.size}]>"
    bound = f"[{kind.maximum_size}]" if isinstance(kind, BoundedSequence) else ""
    return f"<sequence type: {name}{bound}, length: {length}>"


def parse_values(text: str) -> dict[str, Any]:
    """Return the field values that a user has typed in as YAML.

    Raises:
        CommandError: If it is not a YAML mapping.
    """
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CommandError(f"'{text}' is not YAML: {error}") from None
    if values in (None, ""):
        return {}
    if not isinstance(values, dict):
        raise CommandError(f"'{text}' must be a dictionary of field names and values, such as '{{data: 1}}'")
    return values


def fill(message: Message, values: dict[str, Any], now: Time) -> None:
    """Set fields of a message.

    Args:
        message: The message to fill.
        values: Field name -> value, nested like the message. `auto` for a header and `now` for a stamp give the time.
        now: The `builtin_interfaces/msg/Time` of "auto" and "now".

    Raises:
        CommandError: If there is no such field, or a value does not fit it.
    """
    kinds = message.get_fields_and_field_types()
    for name, value in values.items():
        if name not in kinds:
            raise CommandError(f"{type(message).__name__} has no field '{name}': expected one of {', '.join(kinds)}")
        try:
            setattr(message, name, _convert(value, kinds[name], now))
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, CommandError):
                raise
            raise CommandError(f"{value!r} does not fit field '{name}' of type {kinds[name]}") from None


def _convert(value: Any, kind: str, now: Time) -> Any:
    """Return a value as the field of a message takes it."""
    sequence = _SEQUENCE.match(kind)
    if sequence:
        return [_convert(item, sequence["element"] or sequence["fixed"], now) for item in value]
    if "/" in kind:
        nested = import_type(kind, "msg")()
        if kind == "builtin_interfaces/Time" and value == "now":
            return now
        if kind == "std_msgs/Header" and value == "auto":
            value = {"stamp": "now"}
        if not isinstance(value, dict):
            raise TypeError
        fill(nested, value, now)
        return nested
    if kind in _FLOATS and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return value
