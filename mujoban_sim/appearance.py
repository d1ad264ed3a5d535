"""What the world looks like: wall and floor textures drawn anew each episode, and a skyline that never changes.

Everything is drawn in code from a seed (paper appendix B: colours and textures of floor and walls are
randomised in each episode; skylines in the background stay fixed for orientation). Wall and floor colours
keep away from those of boxes and targets, so that the state can be read from a frame.

A *pattern* is a float array [height, width] with values in [0, 1] that blends two colours; it is periodic
along its width, of which one repeat is one cell.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mujoban_sim.meshes import BANDS, SKYLINE_HEIGHTS, SKYLINE_ROWS, SKYLINE_V

Image = NDArray[np.uint8]
Pattern = NDArray[np.float64]
Colour = NDArray[np.float64]

BOX_COLOUR: Final = (0.85, 0.80, 0.12)
BOX_ON_TARGET_COLOUR: Final = (0.05, 0.15, 0.95)
TARGET_COLOUR: Final = (0.90, 0.05, 0.05)
PRESSED_TARGET_COLOUR: Final = (0.05, 0.80, 0.10)
"""RGB in [0, 1] of boxes and target pads (paper appendix B)."""

_CELL_PIXELS: Final = 128
_GUTTER: Final = 8
"""Rows by which a band goes on periodically on either side, so that filtering does not mix bands."""
SKYLINE_SHAPE: Final = (SKYLINE_ROWS, 2048, 3)
"""Rows, columns and channels of the skyline's texture."""

_APPEARANCE_STREAM: Final = 0x41505052
_SKYLINE_SEED: Final = 20200214

# (hue range in degrees, saturation range, value range): none is near the red, green, blue or yellow of pads and boxes.
_PALETTE: Final = (
    ((0.0, 360.0), (0.0, 0.10), (0.30, 0.85)),
    ((0.0, 360.0), (0.0, 0.10), (0.30, 0.85)),
    ((18.0, 36.0), (0.20, 0.50), (0.35, 0.75)),
    ((165.0, 200.0), (0.15, 0.55), (0.35, 0.75)),
    ((265.0, 315.0), (0.12, 0.40), (0.35, 0.75)),
)
_MIN_CONTRAST: Final = 0.25
"""Least distance in RGB between the mean colours of walls and floor."""


def _stretch(values: Pattern, factor: int) -> Pattern:
    """Interpolate periodic lattice values linearly along the first axis, [L, M] -> [factor L, M]."""
    weight = (np.arange(factor) / factor)[:, None]
    following = np.roll(values, -1, axis=0)
    return (values[:, None] * (1.0 - weight) + following[:, None] * weight).reshape(-1, values.shape[1])


def _fractal_noise(rng: np.random.Generator, shape: tuple[int, int], octaves: int = 5) -> Pattern:
    """Value noise in [0, 1], periodic with a cell along both axes; `shape` is at most a cell."""
    total = np.zeros((_CELL_PIXELS, _CELL_PIXELS))
    for octave in range(octaves):
        count = 4 << octave
        factor = _CELL_PIXELS // count
        lattice = 0.55**octave * rng.random((count, count))
        total += _stretch(_stretch(lattice, factor).T, factor).T
    low, high = total.min(), total.max()
    return ((total - low) / (high - low))[: shape[0], : shape[1]]


@cache
def _grid_coordinates(shape: tuple[int, int]) -> tuple[Pattern, Pattern]:
    """Return (row, column) of pixels in cells, each of `shape`; shared, so read only."""
    rows, cols = np.indices(shape) / _CELL_PIXELS
    return rows, cols


def _bricks(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    across, down = int(rng.integers(2, 5)), int(rng.integers(4, 9))
    y, x = _grid_coordinates(shape)
    course = np.floor(y * down)
    u = x * across + 0.5 * (course % 2)
    joint = 0.06 * rng.uniform(0.8, 1.8)
    mortar = ((u % 1.0) < joint) | ((y * down % 1.0) < joint * down / across)
    tone = rng.random((64, across))[course.astype(int) % 64, np.floor(u).astype(int) % across]
    return np.where(mortar, 1.0, 0.35 * tone)


def _tiles(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    count = int(rng.integers(2, 6))
    y, x = _grid_coordinates(shape)
    u, v = x * count, y * count
    joint = rng.uniform(0.05, 0.12)
    tone = rng.random((64, count))[np.floor(v).astype(int) % 64, np.floor(u).astype(int) % count]
    return np.where(((u % 1.0) < joint) | ((v % 1.0) < joint), 1.0, 0.4 * tone)


def _planks(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    count = int(rng.integers(3, 7))
    y, x = _grid_coordinates(shape)
    board = np.floor(x * count).astype(int) % count
    grain = _fractal_noise(rng, (shape[0], shape[1]), 4)
    shift = rng.random(count)[board]
    streaks = 0.5 + 0.5 * np.sin(2 * np.pi * (6 * (x * count % 1.0) + 1.5 * grain + shift))
    gap = ((x * count) % 1.0) < 0.08
    end = ((y + shift) % 1.0) < 0.02
    return np.where(gap | end, 1.0, 0.25 * shift + 0.35 * streaks * grain)


def _noise(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    return _fractal_noise(rng, shape, int(rng.integers(3, 6)))


def _checks(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    count = 2 * int(rng.integers(1, 4))
    y, x = _grid_coordinates(shape)
    return ((np.floor(x * count) + np.floor(y * count)) % 2) * rng.uniform(0.5, 1.0)


def _stripes(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    count, slope = int(rng.integers(2, 8)), int(rng.integers(-2, 3))
    y, x = _grid_coordinates(shape)
    return (((x * count + y * slope * count / 2) % 1.0) < rng.uniform(0.25, 0.6)).astype(float)


def _dots(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    count = int(rng.integers(3, 8))
    y, x = _grid_coordinates(shape)
    row = np.floor(y * count)
    u, v = (x * count + 0.5 * (row % 2)) % 1.0 - 0.5, (y * count) % 1.0 - 0.5
    return (np.hypot(u, v) < rng.uniform(0.2, 0.4)).astype(float)


def _speckle(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    coarse = rng.random((shape[0] // 2, shape[1] // 2)) < rng.uniform(0.05, 0.3)
    return 0.8 * coarse.repeat(2, axis=0).repeat(2, axis=1) + 0.2 * _fractal_noise(rng, shape, 3)


def _marble(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    y, x = _grid_coordinates(shape)
    warp = _fractal_noise(rng, shape, 5)
    veins = np.abs(np.sin(2 * np.pi * (x * int(rng.integers(1, 3)) + y * int(rng.integers(0, 3)) + 1.2 * warp)))
    return 1.0 - veins ** rng.uniform(0.3, 0.8)


def _panels(rng: np.random.Generator, shape: tuple[int, int]) -> Pattern:
    y, x = _grid_coordinates(shape)
    count = int(rng.integers(1, 4))
    u, v = (x * count) % 1.0, (y * count) % 1.0
    edge = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    return np.where(edge < 0.05, 1.0, np.where(edge < 0.12, 0.0, 0.4))


PATTERNS: Final[tuple[Callable[[np.random.Generator, tuple[int, int]], Pattern], ...]] = (
    _bricks,
    _tiles,
    _planks,
    _noise,
    _checks,
    _stripes,
    _dots,
    _speckle,
    _marble,
    _panels,
)


def _draw_colour(rng: np.random.Generator) -> Colour:
    """Draw an RGB colour in [0, 1] from the palette, [3]."""
    hue, saturation, value = _PALETTE[int(rng.integers(len(_PALETTE)))]
    h = rng.uniform(*hue) / 360.0
    return np.array(colorsys.hsv_to_rgb(h, rng.uniform(*saturation), rng.uniform(*value)))


def _paint(rng: np.random.Generator, colour: Colour, grit: Pattern) -> NDArray[np.float64]:
    """Return a texture around a colour, roughened by `grit`, [height, width, 3]."""
    shape = (grit.shape[0], grit.shape[1])
    pattern = PATTERNS[int(rng.integers(len(PATTERNS)))](rng, shape)
    second = np.clip(colour * rng.choice([rng.uniform(0.55, 0.8), rng.uniform(1.2, 1.4)]), 0.0, 0.92)
    return (colour + pattern[..., None] * (second - colour)) * grit[..., None]


@dataclass(frozen=True)
class Atlas:
    """The texture of an episode's walls, floor and pegs: bands along v, see `mujoban_sim.meshes.BANDS`.

    Attributes:
        wall_height: height of drawn walls in cells, which is that of the band of their sides.
    """

    wall_height: float

    @cached_property
    def _band_pixels(self) -> dict[str, int]:
        """Rows of each band."""
        return {
            "side": round(_CELL_PIXELS * self.wall_height),
            "top": _CELL_PIXELS,
            "floor": _CELL_PIXELS,
            "peg": 16,
        }

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and channels."""
        return sum(self._band_pixels.values()) + 2 * _GUTTER * len(BANDS), _CELL_PIXELS, 3

    def band_range(self, band: str) -> tuple[float, float]:
        """Return the range of texture coordinate v of a band."""
        before = BANDS[: BANDS.index(band)]
        first = sum(self._band_pixels[b] for b in before) + _GUTTER * (2 * len(before) + 1)
        return first / self.shape[0], (first + self._band_pixels[band]) / self.shape[0]

    def draw(self, seed: int) -> Image:
        """Draw the texture; the same seed gives the same pixels.

        Args:
            seed: the episode's seed, >= 0.

        Returns:
            RGB of `shape`; row 0 is at v = 0.
        """
        rng = np.random.default_rng([_APPEARANCE_STREAM, seed])
        grit = 1.0 + 0.08 * (_fractal_noise(rng, (_CELL_PIXELS, _CELL_PIXELS)) - 0.5)
        wall = _draw_colour(rng)
        bands = {
            "side": _paint(rng, wall, grit[: self._band_pixels["side"]]),
            "top": _paint(rng, np.clip(wall * rng.choice([0.75, 1.2]), 0.0, 0.9), grit),
            "floor": _paint(rng, _draw_colour(rng), grit),
            "peg": np.full((self._band_pixels["peg"], _CELL_PIXELS, 3), 0.45),
        }
        while min(np.linalg.norm(_mean(bands[b]) - _mean(bands["floor"])) for b in ("side", "top")) < _MIN_CONTRAST:
            bands["floor"] = _paint(rng, _draw_colour(rng), grit)
        floor = _mean(bands["floor"])
        _outline(bands["floor"], np.clip(floor * (0.55 if floor.mean() > 0.4 else 1.6), 0.0, 0.9), 4)
        _outline(bands["top"], 0.75 * _mean(bands["top"]), 3)
        rows = [np.pad(bands[b], ((_GUTTER, _GUTTER), (0, 0), (0, 0)), mode="wrap") for b in BANDS]
        return np.rint(255 * np.clip(np.concatenate(rows), 0.0, 1.0)).astype(np.uint8)


def _mean(image: NDArray[np.float64]) -> Colour:
    """Return an image's mean colour, [3]."""
    return image.mean(axis=(0, 1))


def _outline(image: NDArray[np.float64], colour: Colour, width: int) -> None:
    """Draw the border of a cell into its texture, in place."""
    image[:width] = image[-width:] = colour
    image[:, :width] = image[:, -width:] = colour


@cache
def draw_skyline() -> Image:
    """Draw the skyline, the same for every episode.

    Each direction has its own hue and kind of building, so that a glance at the horizon tells the heading.

    Returns:
        RGB of `SKYLINE_SHAPE`; row 0 (v = 0) is the ground below the horizon, u runs from east by north.
    """
    rng = np.random.default_rng(_SKYLINE_SEED)
    rows, cols, _ = SKYLINE_SHAPE
    v = (np.arange(rows) + 0.5) / rows
    # Tangent of the elevation of each row.
    height = np.interp(v, SKYLINE_V, SKYLINE_HEIGHTS)
    sky_low, sky_high = np.array([0.80, 0.84, 0.88]), np.array([0.50, 0.62, 0.76])
    blend = np.clip(height / SKYLINE_HEIGHTS[-1], 0.0, 1.0)[:, None]
    image = np.repeat((sky_low + blend * (sky_high - sky_low))[:, None], cols, axis=1)
    image[height < 0.0] = np.array([0.36, 0.37, 0.36])
    for layer in range(2):
        _draw_buildings(rng, image, height, far=layer == 0)
    return np.rint(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def _draw_buildings(
    rng: np.random.Generator, image: NDArray[np.float64], height: NDArray[np.float64], far: bool
) -> None:
    """Draw one row of houses around the horizon, in place."""
    cols = image.shape[1]
    column = 0
    while column < cols:
        width = int(rng.integers(cols // 90, cols // 30))
        end = min(column + width, cols)
        heading = 2 * np.pi * (column + width / 2) / cols
        # Tall in the north-east, low in the south-west; hue turns once around the horizon.
        tall = (0.14 + 0.07 * np.cos(heading - np.pi / 4)) * rng.uniform(0.6, 1.35) * (1.25 if far else 0.8)
        hue, saturation = heading / (2 * np.pi), 0.20 if far else 0.42
        colour = np.array(colorsys.hsv_to_rgb(hue, saturation, 0.70 if far else rng.uniform(0.35, 0.55)))
        body = (height >= 0.0) & (height < tall)
        image[body, column:end] = colour
        if not far:
            _draw_windows(rng, image, np.flatnonzero(body), column, end, colour)
        column = end + int(rng.integers(0, cols // 80))


def _draw_windows(
    rng: np.random.Generator, image: NDArray[np.float64], rows: NDArray[np.int64], start: int, end: int, colour: Colour
) -> None:
    """Light some windows of a house, in place."""
    for row in rows[3:-3:5]:
        for col in range(start + 4, end - 6, 8):
            if rng.random() < 0.6:
                image[row : row + 2, col : col + 4] = np.clip(colour * rng.uniform(1.3, 1.9), 0.0, 0.95)
