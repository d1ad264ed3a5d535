"""How a body that does not feel its heading keeps it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mujoban_controller.controller import Recurrent, Sight, VisuomotorController
from mujoban_controller.distil import DistilConfig, GoalHead, imitation_loss
from mujoban_controller.orientation import NEEDLE, SIGHT, Compass, heading_of
from mujoban_controller.skyline import HEADINGS, Skyline, heading_loss, unit
from mujoban_core.bodies import ANT, BALL
from mujoban_core.camera import project
from mujoban_core.grid import CONTROL_PERIOD, Instruction
from mujoban_core.interfaces import ControllerInput


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


def test_an_ant_that_stands_otherwise_does_the_same_for_an_instruction_turned_as_it_is() -> None:
    torch.manual_seed(0)
    controller = VisuomotorController("ant", (8, 8), 64, 64).eval()
    assert controller.compass is not None and VisuomotorController(BALL.name, (8, 8), 8, 8).compass is None
    frame = np.random.default_rng(0).integers(0, 255, (1, 64, 64, 3)).astype(np.uint8)
    proprio = np.random.default_rng(1).normal(size=(1, ANT.proprio_size)).astype(np.float32)
    torques = []
    with torch.no_grad():
        controller.body_encoder[0].weight[:, -6:-1] = 0.0  # the instruction itself
    for instruction, shown in ((Instruction.EAST, 0.0), (Instruction.NORTH, 90.0), (Instruction.NORTH, 270.0)):
        controller.read = lambda *seen, shown=shown: Sight(_sight(shown, shown), None)
        inputs = ControllerInput(np.array([int(instruction)]), frame, proprio, np.array([True]), None)
        torques.append(controller.step(inputs, controller.initial_memory(1))[0])
    np.testing.assert_allclose(torques[0], torques[1], atol=1e-6)
    assert np.abs(torques[0] - torques[2]).max() > 1e-5  # what lies behind it is another thing


def test_the_heading_counts_in_the_loss_of_distillation_and_teaches_the_compass() -> None:
    controller, config = VisuomotorController("ant", (8, 8), 8, 8), DistilConfig()
    m, w = 3, 4
    output = controller(
        torch.randint(0, 255, (m, w, 64, 64, 3), dtype=torch.uint8), torch.randn(m, w, ANT.proprio_size),
        torch.randint(0, 5, (m, w)), torch.zeros(m, w, dtype=torch.bool), Recurrent(*controller.initial_memory(m)),
    )  # fmt: skip
    batch = {
        "label": torch.zeros(m, w, ANT.action_size), "kind": torch.zeros(m, w, dtype=torch.int64),
        "instruction": torch.ones(m, w, dtype=torch.int64), "goal": torch.zeros(m, w, 4),
        "pose": torch.full((m, w, 3), 2.0),
    }  # fmt: skip
    loss, statistics = imitation_loss(output, GoalHead(16), batch, config, ANT.cell_size)
    loss.backward()
    assert controller.compass is not None and output.heading is not None
    for weights in (controller.compass.lines.weight, controller.compass.skyline.panorama):
        assert weights.grad is not None and weights.grad.isfinite().all() and weights.grad.abs().sum() > 0
    off = (output.heading.detach() * unit(torch.tensor(2.0))).sum(-1).acos().rad2deg()
    assert float(statistics["error/heading_degrees"]) == pytest.approx(float(off.median()), abs=0.1)
    assert float(statistics["error/heading_lost"]) == pytest.approx(float((off > 45.0).float().mean()))
