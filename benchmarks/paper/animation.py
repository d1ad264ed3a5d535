"""A short animation for pages: `python -m benchmarks.paper.animation docs/images/episode.gif`.

Plays a recorded episode again, by default that of Figure 3, and draws what the robot sees beside the view from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import tyro
from PIL import Image

from benchmarks.paper import film
from bringup.options import one_of
from mujoban_core.bodies import BALL
from mujoban_core.program import read_options, run_command

PROG: Final = "benchmarks.paper.animation"


@dataclass(frozen=True)
class Options:
    """What is drawn."""

    path: Annotated[Path, tyro.conf.Positional] = Path("docs/images/episode.gif")
    body: Annotated[str, one_of(sorted(film.FILMS))] = BALL.name
    """Whose episode."""
    frames: int = 60
    size: int = 320
    """Pixels along the edges of each of the two pictures."""
    milliseconds: int = 110
    """Between two frames."""
    colours: int = 32


def draw(options: Options) -> None:
    """Write the animation.

    Raises:
        ValueError: If no episode has been recorded, or the world has changed since.
        RenderingError: If there is no OpenGL.
    """
    recorded = film.FILMS[options.body]
    episode = film.load(recorded)
    if episode is None:
        raise ValueError(f"no episode has been recorded yet: {recorded.rerun}")
    moments = np.linspace(0, len(episode["torque"]), options.frames).round().astype(int)
    pictures: list[Image.Image] = []
    for _, first_person, top_down in film.play(episode, moments.tolist(), top_size=options.size):
        left = Image.fromarray(first_person).resize((options.size, options.size), Image.Resampling.NEAREST)
        pair = np.concatenate([np.asarray(left), top_down], axis=1)
        # Maximum coverage keeps the few pixels of a target or a box as bright as they are.
        picture = Image.fromarray(pair)
        pictures.append(picture.quantize(options.colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE))
    pictures[0].save(
        options.path, save_all=True, append_images=pictures[1:], duration=options.milliseconds, loop=0, optimize=True
    )
    print(f"{options.path}: {options.path.stat().st_size / 1e3:.0f} kB")


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    draw(read_options(Options, command_line, PROG, __doc__))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
