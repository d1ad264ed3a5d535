"""How a body that does not feel its heading keeps it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mujoban_core.bodies import ANT
from mujoban_core.camera import project
from mujoban_core.grid import CONTROL_PERIOD
from mujoban_rl.sight.orientation import NEEDLE, SIGHT, Compass, heading_of
from mujoban_rl.sight.skyline import HEADINGS, Skyline, heading_loss, unit


def _facing(needle: torch.Tensor) -> float:
    x, y = heading_of(needle)[0].tolist()
    return math.degrees(math.atan2(y, x))


def _turning(rate: float, lean: float = 0.0) -> torch.Tensor:
    """Return what an ant feels that turns about the vertical while it leans to the front."""
    proprio = torch.zeros(1, ANT.proprio_size)
    up = torch.tensor([math.sin(lean), 0.0, math.cos(lean)])
    proprio[0, ANT.proprio.up_axis] = up
    proprio[0, ANT.proprio.angular_velocity] = rate * up
    return proprio


def _sight(skyline: float | None = None, lines: float | None = None) -> torch.Tensor:
    """Return what a frame shows that tells headings in degrees by the skyline and by the lines, or is blind."""
    sight = torch.zeros(1, SIGHT)
    if skyline is not None:
        sight[0, round(skyline / 360 * HEADINGS) % HEADINGS] = 12.0
    if lines is not None:
        sight[0, HEADINGS:] = unit(torch.tensor(4 * math.radians(lines)))
    return sight


@torch.no_grad()
def test_a_needle_goes_with_turns_and_comes_round_to_what_is_seen() -> None:
    compass, needle = Compass(ANT, 8), torch.zeros(1, NEEDLE)
    needle = compass(_sight(0.0, 0.0), _turning(0.0), needle)
    for _ in range(20):  # a quarter turn to the left in a second
        needle = compass(_sight(), _turning(0.5 * math.pi, lean=0.3), needle)
    assert _facing(needle) == pytest.approx(90.0, abs=0.1)
    for _ in range(20):
        needle = compass(_sight(180.0, 180.0), _turning(0.0), needle)
    assert abs(_facing(needle)) == pytest.approx(180.0, abs=3.0)


@torch.no_grad()
def test_lines_tell_the_heading_within_the_quarter_that_the_skyline_told_once() -> None:
    compass = Compass(ANT, 8)
    needle = compass(_sight(270.0, 264.0), _turning(0.0), torch.zeros(1, NEEDLE))
    assert _facing(needle) == pytest.approx(-96.0, abs=0.1)
    # Behind walls for ten seconds, while the gyro strays by a degree in each tick.
    for _ in range(200):
        needle = compass(_sight(lines=264.0), _turning(math.radians(1.0) / 0.05), needle)
    assert _facing(needle) == pytest.approx(-96.0, abs=10.0)


@torch.no_grad()
def test_a_blind_frame_counts_for_little_beside_one_that_shows_the_skyline() -> None:
    compass = Compass(ANT, 8)
    needle = compass(_sight(90.0, 90.0), _turning(0.0), torch.zeros(1, NEEDLE))
    vague = _sight(lines=90.0)  # it rather looks the other way
    vague[0, :HEADINGS] = 0.2 * torch.cos(torch.arange(HEADINGS) * math.tau / HEADINGS + math.pi / 2)
    for _ in range(20):
        needle = compass(vague, _turning(0.0), needle)
    assert _facing(needle) == pytest.approx(90.0, abs=1.0)


@pytest.mark.parametrize("heading", [-140.0, -50.0, 2.0, 44.0, 130.0])
@torch.no_grad()
def test_two_frames_that_leave_two_quarters_each_tell_the_heading_together(heading: float) -> None:
    compass, needle = Compass(ANT, 8), torch.zeros(1, NEEDLE)
    first = torch.maximum(_sight(heading, heading), _sight(heading + 90.0))
    # In between it turns to the left by two degrees, by which the quarter may change that its lines lie in.
    then = torch.maximum(_sight(heading + 2.0, heading + 2.0), _sight(heading + 182.0))
    first[0, HEADINGS:], then[0, HEADINGS:] = (_sight(lines=x)[0, HEADINGS:] for x in (heading, heading + 2.0))
    needle = compass(first, _turning(0.0), needle)
    needle = compass(then, _turning(math.radians(2.0) / CONTROL_PERIOD), needle)
    off = (_facing(needle) - heading - 2.0 + 180.0) % 360.0 - 180.0
    assert off == pytest.approx(0.0, abs=0.1)


UPRIGHT = torch.tensor([[0.0, 0.0, 1.0]])


def test_a_strip_is_laid_out_by_direction() -> None:
    skyline = Skyline(ANT.camera)
    # Each pixel's place stands in its colours.
    rows, columns = np.mgrid[:64, :64].astype(np.float32)
    frame = torch.from_numpy(np.stack([columns, rows, np.full_like(rows, 255.0)], -1))[None]
    u, v, inside = 255.0 * (skyline.strip(frame, UPRIGHT)[0] + 0.5)
    azimuth, elevation = skyline.azimuth.numpy(), skyline.elevation.numpy()[:, None]
    far = 1e6 * np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), elevation), -1)
    pixels = project(far.reshape(-1, 3), np.zeros(3), ANT.camera).pixels.reshape(*u.shape, 2)
    shown = inside.numpy() > 254.0
    assert shown[:, 4:-4].all() and not shown[:, [0, -1]].all()
    np.testing.assert_allclose(np.stack([u, v], -1)[shown], pixels[shown], atol=0.01)


def test_a_robot_that_leans_sees_the_same_around_the_horizon() -> None:
    frame = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(0)) * 255.0
    for lean in (-0.1, 0.15):  # to the front, which is as if the camera hung lower
        leaning = torch.tensor([[-math.sin(lean), 0.0, math.cos(lean)]])
        lower = replace(ANT.camera, pitch=ANT.camera.pitch + lean)
        torch.testing.assert_close(Skyline(ANT.camera).strip(frame, leaning), Skyline(lower).strip(frame, UPRIGHT))


def test_the_loss_of_the_skyline_is_least_where_logits_point_in_the_heading() -> None:
    heading = torch.tensor([0.0, 1.0, -2.5, 6.2])
    headings = torch.arange(HEADINGS) * (math.tau / HEADINGS)
    degrees = [-90.0, -5.0, -1.0, 0.0, 1.0, 5.0, 90.0]
    logits = [400.0 * torch.cos(headings - heading[:, None] - math.radians(off)) for off in degrees]
    losses = [float(heading_loss(x, heading)) for x in logits]
    assert int(np.argmin(losses)) == 3
