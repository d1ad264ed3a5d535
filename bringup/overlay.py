"""What is drawn over a video: the instruction in force, p(beta), the estimate as a small map, who is told the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mujoban_core.grid import AGENT, BOX, CONTROL_PERIOD, OFFSETS_RC, TARGET, WALL, Instruction
from mujoban_core.plugins import TOLD

CELL: Final = 10
"""Pixels along the edge of a cell of the small map."""
BAR: Final = 32
"""Pixels of the line of text at the bottom."""
MARGIN: Final = 8
"""Pixels from the corner of the picture to the map."""
_FONT_SIZE: Final = 18
_SMALL: Final = 14
_YELLOW: Final = (240, 220, 60)
"""As the same line is on a terminal (`bringup.view`)."""
_BACKGROUND: Final = 30.0
COLOURS: Final = {
    "wall": (150, 140, 140),
    "target": (200, 30, 30),
    "robot": (250, 250, 250),
    "box": (230, 200, 30),
    "box on a target": (40, 90, 230),
}
"""RGB of what a map shows; boxes and targets are as in the world."""
_BOX_SIZE: Final = 0.7
_ROBOT_SIZE: Final = 0.6
"""Edge of a box and diameter of the robot in a map, of a cell: what they stand on shows around them."""


class Said(NamedTuple):
    """What the modules said in a tick."""

    instruction: int
    sequence: int
    """Number of the instruction within its episode."""
    probability: float
    """p(beta)."""
    estimate: NDArray[np.float32]
    """Abstract state, probabilities [N, N, 4]."""


def grid_picture(state: NDArray[np.float32], cell: int = CELL) -> NDArray[np.uint8]:
    """Return an abstract state as a map in which all layers show, the more the surer they are.

    Args:
        state: Probabilities, [N, N, 4].
        cell: Pixels along the edge of a cell.

    Returns:
        RGB, [N cell, N cell, 3].
    """
    large = np.repeat(np.repeat(state, cell, axis=0), cell, axis=1)[..., None]
    across = np.abs((np.arange(cell) + 0.5) / cell - 0.5)
    corner = np.maximum(across[:, None], across)
    square, disc = 2 * corner <= _BOX_SIZE, 2 * np.hypot(across[:, None], across) <= _ROBOT_SIZE
    box, agent = (
        np.tile(shape, state.shape[:2])[..., None] * large[..., layer, :]
        for shape, layer in ((square, BOX), (disc, AGENT))
    )
    canvas = np.full((*large.shape[:2], 3), _BACKGROUND, np.float32)
    for name, weight in (
        ("wall", large[..., WALL, :]),
        ("target", large[..., TARGET, :]),
        ("box", box),
        ("box on a target", box * large[..., TARGET, :]),
        ("robot", agent),
    ):
        canvas += weight * (np.array(COLOURS[name], np.float32) - canvas)
    return canvas.astype(np.uint8)


def draw(picture: NDArray[np.uint8], said: Said, step: int) -> NDArray[np.uint8]:
    """Return the picture, [H, W, 3], with the estimate in its upper left corner and a line of text at the bottom."""
    image = Image.fromarray(picture)
    brush = ImageDraw.Draw(image)
    cells = grid_picture(said.estimate)
    brush.rectangle((MARGIN - 2, MARGIN - 2, MARGIN + cells.shape[1] + 1, MARGIN + cells.shape[0] + 1), fill="white")
    image.paste(Image.fromarray(cells), (MARGIN, MARGIN))
    top = image.height - BAR
    brush.rectangle((0, top, image.width, image.height), fill=(0, 0, 0))
    _draw_arrow(brush, (BAR / 2, top + BAR / 2), said.instruction)
    name = Instruction(said.instruction).name.lower()
    text = f"{name}, number {said.sequence}    p(beta) {said.probability:.2f}    {step * CONTROL_PERIOD:.1f} s"
    brush.text((BAR + 4, top + BAR / 2), text, fill="white", anchor="lm", font=ImageFont.load_default(_FONT_SIZE))
    return np.asarray(image)


def name_told(picture: NDArray[np.uint8], told: Sequence[str]) -> NDArray[np.uint8]:
    """Return the picture, [H, W, 3], with a line at the bottom that names who is told the ground truth, if anybody."""
    if not told:
        return picture
    image = Image.fromarray(picture)
    brush = ImageDraw.Draw(image)
    top = image.height - BAR
    brush.rectangle((0, top, image.width, image.height), fill=(0, 0, 0))
    text = f"{TOLD}:\n{', '.join(told)}"
    font = ImageFont.load_default(_SMALL)
    brush.text((4, top + BAR / 2), text, fill=_YELLOW, anchor="lm", font=font, spacing=1)
    return np.asarray(image)


def _draw_arrow(brush: ImageDraw.ImageDraw, centre: tuple[float, float], instruction: int) -> None:
    """Draw the instruction's direction as a triangle, north upwards; `stay` is a disc."""
    x, y = centre
    down, right = OFFSETS_RC[instruction]
    size = 0.35 * BAR
    if instruction == Instruction.STAY:
        brush.ellipse((x - size / 2, y - size / 2, x + size / 2, y + size / 2), fill="white")
        return
    tip = (x + size * right, y + size * down)
    base = [(x - size * right + side * size * down, y - size * down + side * size * right) for side in (-1, 1)]
    brush.polygon([tip, *base], fill="white")
