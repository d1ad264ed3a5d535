"""How a camera policy acts by its teacher's layers on what it guesses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.distil import DistilConfig, DistilLearner, GoalHead, imitation_loss
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.orientation import Sides
from mujoban_controller.skill import GUESSED, Skill, guess_loss, guessed_features
from mujoban_core.bodies import ANT, BALL
from mujoban_sim.oracles import OraclePlanner

SURE = 30.0
"""A logit."""


def _guess(features: torch.Tensor) -> torch.Tensor:
    """Return the guess that is right."""
    vectors, speed, kind, around = guessed_features(features)
    return torch.cat([vectors, speed, SURE * kind, SURE * (2.0 * around - 1.0)], -1)


@pytest.fixture(params=[BALL, ANT], ids=lambda body: body.name)
def body(request):
    return request.param


@pytest.fixture
def task(body):
    config = GoalTaskConfig(batch=24, body=body.name, difficulty=3, horizon=40.0)
    return GoalTask(config, OraclePlanner(), SeededEpisodes(3, 10_000_000), np.random.default_rng(0))


def test_who_guesses_right_does_what_the_teacher_does(body, task):
    torch.manual_seed(0)
    skill, sides = Skill(body, 8, 16), Sides(body)
    for parameter in skill.teacher.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    torque, rng = torch.zeros(task.torque.shape), np.random.default_rng(1)
    elapsed = torch.zeros(len(torque), 1)
    for _ in range(60):
        inputs = task.observe()
        began = torch.from_numpy(inputs.terminated | task.first)[:, None]
        torque[torch.from_numpy(task.first)] = 0.0
        elapsed = torch.where(began, 0.0, elapsed + 1.0)
        features = torch.from_numpy(task.features())
        heading = torch.from_numpy(task.world.pose[:, 2]).float()
        facing = torch.stack([heading.cos(), heading.sin()], -1), torch.from_numpy(inputs.instruction)
        side = torch.from_numpy(task.side)
        action = skill(
            _guess(features), sides.felt(torch.from_numpy(inputs.proprio), side), sides.relative(*facing, side),
            sides.actions(torque, side), elapsed,
        )  # fmt: skip
        with torch.no_grad():
            torch.testing.assert_close(action, skill.teacher(features).mean, atol=1e-3, rtol=1e-3)
        assert float(guess_loss(_guess(features), features)) < 1e-3
        torque = torch.from_numpy(rng.uniform(-1, 1, torque.shape).astype(np.float32))
        task.step(torque.numpy())


def test_the_memory_holds_the_torques_that_were_applied(body):
    controller = VisuomotorController(body.name, (8, 8), 16, 8, place=True, skill=16).eval()
    memory = Recurrent(*controller.initial_memory(2))
    assert memory.track.shape[1] == controller.initial_memory(1)[2].shape[1]
    torque = torch.linspace(-1, 1, 2 * body.action_size).view(2, -1)
    after = controller.applied(memory, torque)
    torch.testing.assert_close(after.track[:, -1 - body.action_size : -1], torque)
    plain = VisuomotorController(body.name, (8, 8), 16, 8)
    assert torch.equal(plain.applied(plain.initial_memory(2), torque).track, plain.initial_memory(2)[2])


def test_a_teachers_layers_stay_as_they_are_while_the_guess_learns(body):
    torch.manual_seed(0)
    m, w = 3, 4
    student = VisuomotorController(body.name, (8, 8), 16, 8, place=True, skill=16)
    learner = DistilLearner(student, DistilConfig(), torch.Generator())
    output = student(
        torch.randint(0, 255, (m, w, 64, 64, 3), dtype=torch.uint8), torch.randn(m, w, body.proprio_size),
        torch.randint(0, 5, (m, w)), torch.zeros(m, w, dtype=torch.bool), Recurrent(*student.initial_memory(m)),
    )  # fmt: skip
    assert output.guess is not None and output.guess.shape == (m, w, GUESSED) and student.skill is not None
    batch = {
        "label": torch.full((m, w, body.action_size), 0.5), "kind": torch.zeros(m, w, dtype=torch.int64),
        "instruction": torch.ones(m, w, dtype=torch.int64), "goal": torch.zeros(m, w, 4), "pose": torch.ones(m, w, 3),
        "features": torch.rand(m, w, student.skill.teacher.normaliser.mean.shape[0]),
    }  # fmt: skip
    loss, _ = imitation_loss(output, GoalHead(24), batch, DistilConfig(), body.cell_size)
    loss.backward()
    assert all(p.grad is None for p in student.skill.teacher.parameters())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in student.skill.guess.parameters())
    assert learner.product.skill is not None
