"""How a body that does not feel its heading keeps it, and puts a side ahead."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.distil import DistilConfig, GoalHead, imitation_loss
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_features import side_ahead
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.orientation import Compass, Sides, heading_of
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput
from mujoban_sim.goals import GoalKind
from mujoban_sim.oracles import OraclePlanner


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


def test_a_needle_goes_with_turns_and_comes_round_to_what_is_seen() -> None:
    compass, blind = Compass(ANT, 8), torch.zeros(1, 2)
    with torch.no_grad():
        needle = compass(torch.tensor([[1.0, 0.0]]), _turning(0.0), blind)
        for _ in range(20):  # a quarter turn to the left in a second
            needle = compass(blind, _turning(0.5 * math.pi, lean=0.3), needle)
        assert _facing(needle) == pytest.approx(90.0, abs=0.1)
        for _ in range(20):
            needle = compass(torch.tensor([[-1.0, 0.0]]), _turning(0.0), needle)
    assert abs(_facing(needle)) == pytest.approx(180.0, abs=3.0)


def test_sides_are_those_of_the_goal_task() -> None:
    config = GoalTaskConfig(batch=16, body="ant", difficulty=2)
    task = GoalTask(config, OraclePlanner(), SeededEpisodes(2, 10_000_000), np.random.default_rng(0))
    sides = Sides(ANT)
    for _ in range(40):
        task.step(np.zeros((16, ANT.action_size), np.float32))
    heading = torch.from_numpy(task.world.pose[:, 2]).float()
    facing = torch.stack([heading.cos(), heading.sin()], 1)
    side = sides.ahead(facing, torch.from_numpy(task.instruction)).numpy()
    task.side = side_ahead(task.world)
    pushing = task.world.goals.kind == GoalKind.PUSH
    assert pushing.any() and np.array_equal(side[pushing], task.side[pushing])
    action = np.random.default_rng(1).normal(size=(16, ANT.action_size)).astype(np.float32)
    own = sides.torques(torch.from_numpy(action), torch.from_numpy(task.side)).numpy()
    np.testing.assert_array_equal(own, task.torque_of(action))


def test_a_side_is_put_ahead_only_where_it_faces_the_instruction() -> None:
    config = GoalTaskConfig(batch=8, body="ant", difficulty=2)
    task = GoalTask(config, OraclePlanner(), SeededEpisodes(2, 10_000_000), np.random.default_rng(0))
    before = task.side.copy()
    task.put_ahead((before + 2) % 4)
    np.testing.assert_array_equal(task.side, before)


def test_an_ant_that_stands_otherwise_does_the_same_for_an_instruction_turned_as_it_is() -> None:
    controller = VisuomotorController("ant", (8, 8), 8, 8).eval()
    assert controller.compass is not None and VisuomotorController(BALL.name, (8, 8), 8, 8).compass is None
    frame = np.random.default_rng(0).integers(0, 255, (1, 64, 64, 3)).astype(np.uint8)
    proprio = np.random.default_rng(1).normal(size=(1, ANT.proprio_size)).astype(np.float32)
    torques = []
    with torch.no_grad():
        controller.body_encoder[0].weight[:, -6:-1] = 0.0  # the instruction itself
    for instruction, shown in ((Instruction.EAST, (1.0, 0.0)), (Instruction.NORTH, (0.0, 1.0))):
        with torch.no_grad():
            controller.compass.read.weight.zero_()
            controller.compass.read.bias.copy_(torch.tensor(shown))
        inputs = ControllerInput(np.array([int(instruction)]), frame, proprio, np.array([True]), None)
        torque, memory = controller.step(inputs, controller.initial_memory(1))
        assert controller.side_ahead(memory).tolist() == [0]
        torques.append(torque)
    np.testing.assert_allclose(torques[0], torques[1], atol=1e-6)
    # It need not turn round for what lies behind it.
    with torch.no_grad():
        controller.compass.read.bias.copy_(torch.tensor((0.0, -1.0)))
    _, memory = controller.step(inputs, controller.initial_memory(1))
    assert controller.side_ahead(memory).tolist() == [2]


def test_the_skyline_counts_in_the_loss_of_distillation_and_teaches_the_compass() -> None:
    controller, config = VisuomotorController("ant", (8, 8), 8, 8), DistilConfig()
    m, w = 3, 4
    output = controller(
        torch.randint(0, 255, (m, w, 64, 64, 3), dtype=torch.uint8), torch.randn(m, w, ANT.proprio_size),
        torch.randint(0, 5, (m, w)), torch.zeros(m, w, dtype=torch.bool), Recurrent(*controller.initial_memory(m)),
    )  # fmt: skip
    batch = {
        "label": torch.zeros(m, w, ANT.action_size), "kind": torch.zeros(m, w, dtype=torch.int64),
        "instruction": torch.ones(m, w, dtype=torch.int64), "goal": torch.zeros(m, w, 4),
        "heading": torch.full((m, w), 2.0),
    }  # fmt: skip
    loss, statistics = imitation_loss(output, GoalHead(16), batch, config)
    loss.backward()
    assert controller.compass is not None and controller.compass.read.weight.grad is not None
    assert controller.compass.read.weight.grad.isfinite().all()
    assert controller.compass.read.weight.grad.abs().sum() > 0
    assert 0.0 <= float(statistics["error/heading_degrees"]) <= 180.0
