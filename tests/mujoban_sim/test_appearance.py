import colorsys
import itertools

import numpy as np
import pytest

from mujoban_sim.appearance import (
    BOX_COLOUR,
    BOX_ON_TARGET_COLOUR,
    PRESSED_TARGET_COLOUR,
    SKYLINE_SHAPE,
    TARGET_COLOUR,
    Atlas,
    draw_skyline,
)
from mujoban_sim.meshes import BANDS

SEEDS = [*range(40), 10_000_000, 2**62 - 1]
ATLAS = Atlas(0.5)


@pytest.fixture(scope="module")
def atlases():
    return [ATLAS.draw(seed) for seed in SEEDS]


def band_pixels(atlas, band):
    low, high = (round(v * ATLAS.shape[0]) for v in ATLAS.band_range(band))
    return atlas[low:high] / 255.0


def test_the_same_seed_gives_the_same_textures():
    np.testing.assert_array_equal(ATLAS.draw(7), ATLAS.draw(7))
    assert ATLAS.draw(7).shape == ATLAS.shape


def test_different_seeds_give_different_textures(atlases):
    assert len({atlas.tobytes() for atlas in atlases}) == len(SEEDS)


@pytest.mark.parametrize("band", ["side", "top", "floor"])
@pytest.mark.parametrize("colour", [BOX_COLOUR, BOX_ON_TARGET_COLOUR, TARGET_COLOUR, PRESSED_TARGET_COLOUR])
def test_walls_and_floor_keep_away_from_the_colours_of_boxes_and_targets(atlases, band, colour):
    chroma = np.array(colour) - np.mean(colour)
    for atlas in atlases:
        pixels = band_pixels(atlas, band)[::2, ::2]
        # Brightness changes with the light, so what tells colours apart is what is left without it.
        distance = np.linalg.norm(pixels - pixels.mean(axis=-1, keepdims=True) - chroma, axis=-1)
        assert distance.min() > 0.2


def test_walls_and_floor_differ_in_every_episode(atlases):
    for atlas in atlases:
        side, top, floor = (band_pixels(atlas, band).mean(axis=(0, 1)) for band in ("side", "top", "floor"))
        assert min(np.linalg.norm(side - floor), np.linalg.norm(top - floor)) > 0.12


@pytest.mark.parametrize("wall_height", [0.5, 1.0])
def test_bands_are_disjoint_and_a_cell_of_wall_is_drawn_as_high_as_it_is_wide(wall_height):
    atlas = Atlas(wall_height)
    low, high = atlas.band_range("side")
    assert (high - low) * atlas.shape[0] == pytest.approx(wall_height * atlas.shape[1])
    ranges = [atlas.band_range(band) for band in BANDS]
    assert all(0 < low < high < 1 for low, high in ranges)
    assert all(high < low for (_, high), (low, _) in itertools.pairwise(ranges))


def test_every_eighth_of_the_horizon_has_its_own_hue():
    rows = SKYLINE_SHAPE[0]
    houses = draw_skyline()[rows // 8 + 4 : rows // 8 + 8] / 255.0
    hues = []
    for part in np.split(houses, 8, axis=1):
        colours = part.reshape(-1, 3)
        strong = colours[np.ptp(colours, axis=-1) > 0.1]
        angle = 2 * np.pi * np.array([colorsys.rgb_to_hsv(*c)[0] for c in strong])
        hues.append(np.angle(np.exp(1j * angle).mean()) % (2 * np.pi))
    apart = np.abs((np.diff([*hues, hues[0]]) + np.pi) % (2 * np.pi) - np.pi)
    assert (apart > np.pi / 8).all()
