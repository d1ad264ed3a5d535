"""What a node that was killed goes on from: the arrays that it had kept last, for the process that comes after it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mujoban_core import trees
from mujoban_msgs_py.seldom import is_due

Kept = TypeVar("Kept")
_LOG_PERIOD: Final = 10.0
"""Seconds between two warnings that nothing can be kept."""


class KeptArrays:
    """A file of arrays by name.

    What is written survives the process, not the machine: nothing waits for the disk.
    """

    def __init__(self, path: Path) -> None:
        """Keep them in a file, whose folder exists."""
        self.path = path
        self._partial = path.with_name(f".{path.name}.part")

    def write(self, arrays: Mapping[str, Any], node: Node) -> None:
        """Replace the file, whole or not at all.

        Where that fails, as on a full disk, the file goes: what it has is of the past, and a node that started from
        there would disagree with the others. The node warns of it and works on.
        """
        try:
            self._partial.write_bytes(save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))
            self._partial.replace(self.path)
        except OSError as error:
            for path in (self._partial, self.path):
                path.unlink(missing_ok=True)
            if is_due(node, "not kept", _LOG_PERIOD):
                node.get_logger().warning(f"{self.path}: {error.strerror}; after a crash this node would start anew")

    def remove(self) -> None:
        """Forget what was kept."""
        self.path.unlink(missing_ok=True)

    def read(self, take: Callable[[dict[str, NDArray[Any]]], Kept]) -> Kept | None:
        """Return what `take` makes of the arrays, or None if there are none yet.

        Raises:
            ValueError: If the file holds no arrays, or `take` refuses them.
        """
        if not self.path.is_file():
            return None
        try:
            return take(load(self.path.read_bytes()))
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{self.path}: expected what this node has kept: {error}") from None


def leaves(state: Any) -> Iterator[NDArray[Any]]:
    """Return the arrays of a module's state, which is any nesting of tuples of arrays and tensors.

    Arrays of objects, which no file can hold, are left out.
    """
    for leaf in trees.leaves(state):
        if not _is_of_objects(leaf):
            yield np.asarray(leaf.cpu() if hasattr(leaf, "cpu") else leaf)


def _is_of_objects(array: Any) -> bool:
    return isinstance(array, np.ndarray) and array.dtype.hasobject


def with_leaves(fresh: Any, kept: Iterator[NDArray[Any]]) -> Any:
    """Return a state like `fresh` with the arrays that `leaves` gave; arrays of objects are those of `fresh`.

    Raises:
        ValueError: If the arrays are not those of such a state.
    """

    def taken(leaf: Any) -> Any:
        if _is_of_objects(leaf):
            return leaf
        expected, array = next(leaves(leaf)), next(kept, None)
        if array is None or array.shape != expected.shape or array.dtype != expected.dtype:
            found = "none" if array is None else f"{array.dtype} {array.shape}"
            raise ValueError(f"expected a state with an array of {expected.dtype} {expected.shape}, found {found}")
        return array if isinstance(leaf, np.ndarray) else leaf.new_tensor(array)

    return trees.map_leaves(taken, fresh)
