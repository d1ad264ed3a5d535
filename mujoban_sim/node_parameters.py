"""The parameters of the simulator's node: their defaults, and what `ros2 param describe` says of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rcl_interfaces.msg import ParameterDescriptor

from mujoban_core.bodies import BALL, BODIES
from mujoban_core.grid import DIFFICULTIES, FASTEST
from mujoban_msgs_py.runtime.descriptors import described
from mujoban_sim.presets import DEFAULT_WORLD, WORLDS
from mujoban_sokoban.episodes import Episodes

LARGEST_PICTURE: Final = 4096
"""Most pixels along its edge."""
_MOST: Final = 2**63 - 1
"""Greatest number that a parameter holds."""
_WORLDS: Final = " or ".join(WORLDS)


def _setting(text: str, low: float | None = None, high: float | None = None) -> ParameterDescriptor:
    return described(text, fixed=True, low=low, high=high)


PARAMETERS: Final[dict[str, tuple[Any, ParameterDescriptor]]] = {
    "seed": (-1, _setting("seed of the first episode; the next ones count on; -1: none for results", -1, _MOST)),
    "episodes": (0, _setting("episodes to play; 0: all levels of a level file, else one", 0, _MOST)),
    "difficulty": (max(DIFFICULTIES), _setting("of generated levels", min(DIFFICULTIES), max(DIFFICULTIES))),
    "level_file": ("", _setting("levels in the Boxoban format; empty: they are generated")),
    "time_limit": (0, _setting("steps of an episode; 0: the body's own", 0, _MOST)),
    "body": (BALL.name, _setting(f"the robot's body: {' or '.join(BODIES)}")),
    "world": (DEFAULT_WORLD, _setting(f"the physical world: {_WORLDS}")),
    "realtime": (0.0, _setting("simulated seconds per second; 0: lockstep", 0.0, FASTEST)),
    "resend_after": (0.2, _setting("seconds without an answer until a tick is offered again", 0.01, 3600.0)),
    "hold_limit": (1, _setting("ticks for which a torque is held in real time until the clock waits", 1, 1000)),
    "await_recorder": (False, _setting("whether in lockstep a recorder must have written a tick before the next")),
    "await_monitor": (False, _setting("whether in lockstep a monitor must have heard a tick before the next")),
    "instructed": (True, _setting("whether torques follow instructions, which a tick then awaits as well")),
    "top_camera_size": (256, _setting("pixels along the edge of /camera_top/image_raw", 1, LARGEST_PICTURE)),
    "resume_file": ("", _setting("file of every tick that is offered, to go on from after a crash; empty: none")),
}
"""Parameters of the simulator: their defaults, and what `ros2 param describe` says of them."""


def episodes_of(settings: Mapping[str, Any]) -> Episodes:
    """Return the episodes that parameters name; what is wrong with a level file is a ValueError or OSError."""
    level_file, seed = settings["level_file"], settings["seed"]
    return Episodes(
        settings["episodes"] or None,
        None if seed < 0 else seed,
        difficulty=settings["difficulty"],
        level_file=Path(level_file) if level_file else None,
    )
