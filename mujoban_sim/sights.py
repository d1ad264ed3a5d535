"""What can be seen and felt of a world, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from numpy.typing import NDArray

from mujoban_core.camera import TOP_DOWN_CAMERA
from mujoban_sim.world import World

Sights = dict[str, NDArray[Any]]
"""Arrays by name."""

_READERS: Final[dict[str, Callable[[World], NDArray[Any]]]] = {
    "frame": World.render,
    "top_down": lambda world: world.render(TOP_DOWN_CAMERA),
    "proprio": lambda world: world.proprio.copy(),
    "pose": lambda world: world.pose.copy(),
    "velocity": lambda world: world.velocity.copy(),
    "box_position": lambda world: world.box_position.copy(),
    "abstract_state": World.abstract_state,
}


def observe(world: World, names: tuple[str, ...]) -> Sights:
    """Return copies of what is named of all rows, each [B, ...]."""
    return {name: _READERS[name](world) for name in names}
