"""A picture of the world: what the robot sees at four moments of an episode, beside the view from above at the last.

Run as ``python -m bringup.picture docs/images/world.png --seed 5``; the episode is played by the oracles.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from bringup.command import Stack, oracle
from bringup.options import WorldOptions
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.files import check_file
from mujoban_core.interfaces import Observation, module_seeds
from mujoban_core.plugins import ROLES
from mujoban_core.program import read_options, run_command
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import PLAY_SEEDS, generate_level

PROG = "bringup.picture"

_SIZE = 480
"""Rows of the picture in pixels; frames are drawn twice as large and scaled down."""
_GAP = 8


@dataclass(frozen=True)
class Picture:
    """Draw a picture of the world."""

    path: Annotated[Path, tyro.conf.Positional]
    """Where to write the PNG."""
    seed: int = PLAY_SEEDS.start
    """Seed of the episode, at least 0."""
    difficulty: int = 5
    """1 to 5."""
    physics: Annotated[WorldOptions, tyro.conf.arg(name="")] = field(default_factory=WorldOptions)
    steps: int = 600
    """Steps of the episode to the last moment, at least 4; 20 are a second."""


def _scaled(frame: NDArray[np.uint8], size: int) -> Image.Image:
    return Image.fromarray(frame).resize((size, size), Image.Resampling.LANCZOS)


def draw_picture(config: Picture) -> Image.Image:
    """Return the picture, RGB.

    Raises:
        RenderingError: if there is no OpenGL.
        ValueError: if an argument is out of its range.
    """
    if config.steps < 4:
        raise ValueError(f"steps is {config.steps}: expected at least 4")
    level = generate_level(config.difficulty, config.seed)
    body = config.physics.body
    world = World(1, body=body, world=config.physics.world, max_boxes=len(level.boxes))
    world.reset([0], [EpisodeSpec(level, config.seed)])
    policy = Stack({role: oracle(role, body) for role in ROLES}, body=body).policy()
    state = policy.initial_state(module_seeds(0, np.array([1])))
    unseen = np.zeros((1, FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    views = []
    for step in range(1, config.steps + 1):
        observation = Observation(unseen, world.proprio.copy(), world.pose.copy())
        decision, state = policy.step(observation, world.truth(), state)
        world.instruct(decision.instruction, decision.issued)
        world.step(decision.torque)
        over = bool(world.solved[0])
        if over or step * 4 // config.steps > len(views):
            views.append(world.render(size=2 * _SIZE)[0])
        if over:
            break
    above = world.render("top_down", size=2 * _SIZE)[0]
    world.close()
    return _compose(above, views[:4])


def _compose(above: NDArray[np.uint8], views: list[NDArray[np.uint8]]) -> Image.Image:
    """Return the view from above with up to four frames in a square to its right."""
    small = (_SIZE - _GAP) // 2
    picture = Image.new("RGB", (2 * _SIZE + _GAP, _SIZE), "white")
    picture.paste(_scaled(above, _SIZE), (0, 0))
    for i, view in enumerate(views):
        row, col = divmod(i, 2)
        picture.paste(_scaled(view, small), (_SIZE + _GAP + col * (small + _GAP), row * (small + _GAP)))
    return picture


def main(command_line: Sequence[str] | None = None) -> int:
    """Draw the picture that the command line asks for."""
    config = read_options(Picture, command_line, PROG, __doc__)
    config.path.parent.mkdir(parents=True, exist_ok=True)
    check_file("PATH", config.path)
    draw_picture(config).save(config.path, optimize=True)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
