"""How a controller uses what frames show of its heading and of where in its cell it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mujoban_controller.controller import Recurrent, Sight, VisuomotorController
from mujoban_controller.distil import DistilConfig, GoalHead, imitation_loss
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput
from mujoban_rl.sight.orientation import SIGHT
from mujoban_rl.sight.skyline import HEADINGS, unit


def _shows(degrees: float) -> torch.Tensor:
    """Return what a frame shows that tells a heading surely."""
    sight = torch.zeros(1, SIGHT)
    sight[0, round(degrees / 360 * HEADINGS)] = 12.0
    sight[0, HEADINGS:] = unit(torch.tensor(4 * degrees).deg2rad())
    return sight


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
        controller.read = lambda *seen, shown=shown: Sight(_shows(shown), None)
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


def test_there_is_no_way_without_a_place() -> None:
    with pytest.raises(ValueError, match="way without place"):
        VisuomotorController("ant", (8, 8), 16, 8, way=True)


@pytest.mark.parametrize("way", [False, True])
@pytest.mark.parametrize("body", [BALL, ANT])
def test_the_place_counts_in_the_loss_of_distillation_and_reaches_the_policy(body, way) -> None:
    torch.manual_seed(0)
    m, w = 3, 4
    controller = VisuomotorController(body.name, (8, 8), 16, 8, place=True, way=way)
    output = controller(
        torch.randint(0, 255, (m, w, 64, 64, 3), dtype=torch.uint8), torch.randn(m, w, body.proprio_size),
        torch.randint(0, 5, (m, w)), torch.zeros(m, w, dtype=torch.bool), controller.initial_memory(m),
    )  # fmt: skip
    assert output.place is not None and controller.place is not None
    reading = controller.place.read.weight
    (gradient,) = torch.autograd.grad(output.action.mean.square().sum(), reading, retain_graph=True)
    assert gradient.abs().sum() > 0
    batch = {
        "label": torch.zeros(m, w, body.action_size), "kind": torch.zeros(m, w, dtype=torch.int64),
        "instruction": torch.ones(m, w, dtype=torch.int64), "goal": torch.zeros(m, w, 4), "pose": torch.ones(m, w, 3),
    }  # fmt: skip
    loss, statistics = imitation_loss(output, GoalHead(24), batch, DistilConfig(), body.cell_size)
    loss.backward()
    assert reading.grad is not None and reading.grad.abs().sum() > gradient.abs().sum()
    assert 0.0 <= float(statistics["error/place"]) <= 0.5
