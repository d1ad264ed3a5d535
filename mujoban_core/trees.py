"""States as trees: any nesting of tuples and NamedTuples, with arrays or tensors as leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

TreeT = TypeVar("TreeT")


def leaves(tree: Any) -> Iterator[Any]:
    """Yield the leaves of a tree, in the order in which `map_leaves` meets them."""
    if isinstance(tree, tuple):
        for part in tree:
            yield from leaves(part)
    else:
        yield tree


def map_leaves(function: Callable[..., Any], tree: TreeT, *others: TreeT) -> TreeT:
    """Return a tree like `tree` of what a function makes of its leaves, and of those of others in the same places.

    Raises:
        ValueError: If the trees differ in their branches.
    """
    return _mapped(function, (tree, *others))


def _mapped(function: Callable[..., Any], trees: tuple[Any, ...]) -> Any:
    tree = trees[0]
    if isinstance(tree, tuple):
        parts = [_mapped(function, branches) for branches in zip(*trees, strict=True)]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return function(*trees)
