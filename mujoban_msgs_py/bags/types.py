"""Message definitions of ROS types, as bags carry them, without a ROS installation."""

from __future__ import annotations

import os
import re
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from mujoban_msgs_py.bags.errors import BagError

MESSAGES: Final = Path(__file__).resolve().parents[1] / "msg"
"""Folder of the interface package's .msg files."""
PACKAGE: Final = "mujoban_msgs"

_MOST_PADDING: Final = 16
"""Bytes that rclpy's `serialize_message` appends at most; messages off the wire have none."""
_REFERENCE: Final = re.compile(r"^\s*([A-Za-z]\w*)/(?:msg/)?([A-Z]\w*)(?:\[[^\]]*\])?\s+[a-z]", re.MULTILINE)


@cache
def known_types() -> TypeRegistry:
    """Return the registry that bags without definitions of their own share in this process: to make one takes 20 ms."""
    return TypeRegistry()


@lru_cache(maxsize=16)
def types_of_schemas(schemas: tuple[tuple[str, str], ...]) -> TypeRegistry:
    """Return the registry that bags with the same definitions share: to make one takes 100 ms, more than opening a bag.

    Raises:
        BagError: As `TypeRegistry.of_schemas`.
    """
    return TypeRegistry.of_schemas(dict(schemas))


class TypeRegistry:
    """Definitions of message types, and CDR to objects with NumPy arrays.

    Knows the types of ROS 2 Jazzy's common interfaces and of `mujoban_msgs`; looks others up in the ROS
    installations that AMENT_PREFIX_PATH names.
    """

    def __init__(self) -> None:
        """Start with the types that need no looking up."""
        self._store = get_typestore(Stores.ROS2_JAZZY)
        for path in sorted(MESSAGES.glob("*.msg")):
            self._store.register(get_types_from_msg(path.read_text(), f"{PACKAGE}/msg/{path.stem}"))

    @classmethod
    def of_schemas(cls, schemas: dict[str, str]) -> TypeRegistry:
        """Return a registry that knows exactly the given types: name -> concatenated definition (ros2msg).

        Raises:
            BagError: If a definition is malformed or two of them contradict each other.
        """
        registry = cls.__new__(cls)
        registry._store = get_typestore(Stores.EMPTY)
        for name, text in schemas.items():
            try:
                registry._store.register(get_types_from_msg(text, name))
            except (TypesysError, SyntaxError) as error:
                raise BagError(f"definition of {name} cannot be read: {error}") from None
        return registry

    def definition(self, type_name: str) -> str:
        """Return the definition of a type followed by those of all types that it uses (ros2msg).

        Raises:
            BagError: If the type is unknown.
        """
        self._require(type_name)
        return self._store.generate_msgdef(type_name, ros_version=2)[0]

    def type_hash(self, type_name: str) -> str:
        """Return the type's hash (REP 2016), such as `RIHS01_...`.

        Raises:
            BagError: If the type is unknown.
        """
        self._require(type_name)
        return self._store.hash_rihs01(type_name)

    def deserialise(self, type_name: str, data: bytes) -> Any:
        """Return a message as an object whose array fields are NumPy arrays.

        Raises:
            BagError: If the type is unknown or `data` is too short for it.
        """
        self._require(type_name)
        first: Exception | None = None
        for padding in range(0, _MOST_PADDING + 1, 4):
            try:
                return self._store.deserialize_cdr(data[: len(data) - padding], type_name)
            except (SerdeError, TypesysError) as error:
                first = first or error
        raise BagError(f"{len(data)} bytes are not a serialised {type_name}: {first}") from None

    def fields(self, type_name: str) -> tuple[str, ...]:
        """Return the names of a type's fields.

        Raises:
            BagError: If the type is unknown.
        """
        self._require(type_name)
        return tuple(name for name, _ in self._store.fielddefs[type_name][1])

    def _require(self, type_name: str) -> None:
        if type_name not in self._store.fielddefs:
            self._register_installed(type_name)

    def _register_installed(self, type_name: str) -> None:
        package, _, name = type_name.partition("/msg/")
        prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
        paths = [p / "share" / package / "msg" / f"{name}.msg" for p in prefixes]
        path = next((p for p in paths if p.is_file()), None)
        if path is None:
            raise BagError(f"message type {type_name!r} is unknown: expected a type of Jazzy or of AMENT_PREFIX_PATH")
        text = path.read_text()
        for used_package, used in _REFERENCE.findall(text):
            self._require(f"{used_package}/msg/{used}")
        self._store.register(get_types_from_msg(text, type_name))
