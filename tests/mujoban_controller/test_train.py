"""Training runs: every stage learns something, stops, resumes and leaves weights with a record."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mujoban_controller import load
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.distil import DistilConfig, GoalHead, imitation_loss
from mujoban_controller.goal_task import GoalTaskConfig
from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_controller.train import NetworkConfig, Options, TrainConfig, TrainingRun, training_episodes
from mujoban_core.grid import Instruction
from mujoban_rl.run_directory import RunError
from mujoban_sim.goals import GoalKind
from mujoban_sokoban.generator import TRAIN_SEEDS

TASK = GoalTaskConfig(batch=4, difficulty=1)
NETWORK = NetworkConfig(channels=(4, 8, 8), features=16, hidden=8)
DISTIL = DistilConfig(length=8, sequences=2, replay=16, reuse=1.0)
MPO = MPOTrainingConfig(length=8, sequences=2, replay=16, reuse=1.0, target_period=2)


def options(path: Path, stage: str, steps: int) -> Options:
    config = TrainConfig(stage=stage, steps=steps, task=TASK, network=NETWORK, distil=DISTIL, mpo=MPO)
    return Options(path, config, evaluation_episodes=0, save_every=0.0)


@pytest.mark.parametrize("stage", ["teacher", "distil", "mpo"])
def test_a_run_stops_and_resumes_where_it_was(stage, tmp_path):
    run = TrainingRun(options(tmp_path, stage, 96))
    for _ in range(2):
        run.learner.collect()
        run.learner.learn()
    run._save()
    resumed = TrainingRun(options(tmp_path, stage, 96))
    assert (resumed.learner.frames, resumed.learner.updates) == (64, run.learner.updates)
    for name, module in run.learner.modules.items():
        for key, value in module.state_dict().items():
            assert torch.equal(value, resumed.learner.modules[name].state_dict()[key]), (name, key)
    resumed.run()
    assert resumed.learner.frames == 96
    record = json.loads((tmp_path / f"{'teacher' if stage == 'teacher' else 'controller'}.json").read_text())
    assert record["steps"] == 96
    assert record["training"]["stage"] == stage
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert all(math.isfinite(v) for v in json.loads(lines[-1]).values() if v is not None)


def test_the_product_of_a_run_loads_as_a_controller(tmp_path):
    TrainingRun(options(tmp_path, "distil", 32)).run()
    controller = load(tmp_path / "controller.safetensors")
    assert controller.hidden == NETWORK.hidden
    assert float(controller.proprio_scale.std()) > 0


def test_a_run_directory_belongs_to_one_configuration(tmp_path):
    TrainingRun(options(tmp_path, "distil", 32))
    with pytest.raises(RunError, match="steps"):
        TrainingRun(options(tmp_path, "distil", 64))


def test_training_levels_are_never_test_levels():
    episodes = training_episodes(1, np.random.default_rng(0))
    assert all(episodes().seed in TRAIN_SEEDS for _ in range(5))


def test_imitation_prefers_the_teachers_torque():
    torch.manual_seed(0)
    controller = VisuomotorController(channels=(4, 8, 8), features=16, hidden=8)
    head = GoalHead(24)
    batch = {
        "frame": torch.zeros(1, 2, 64, 64, 3, dtype=torch.uint8),
        "proprio": torch.zeros(1, 2, controller.proprio_size),
        "instruction": torch.zeros(1, 2, dtype=torch.int64),
        "terminated": torch.zeros(1, 2, dtype=torch.bool),
        "goal": torch.zeros(1, 2, 4),
        "kind": torch.zeros(1, 2, dtype=torch.int64),
        "label": torch.full((1, 2, 2), 0.7),
    }
    optimiser = torch.optim.Adam([*controller.parameters(), *head.parameters()], 1e-2)
    for _ in range(60):
        output = controller(*(batch[k] for k in ("frame", "proprio", "instruction", "terminated")),
                            controller.initial_memory(1))
        loss, stats = imitation_loss(output, head, batch, DISTIL)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert float(stats["error/torque"]) < 0.05
    assert float(output.action.scale.detach().max()) < 0.5


def test_torques_of_blocked_instructions_weigh_as_configured():
    config = replace(DISTIL, infeasible_weight=0.25)
    controller = VisuomotorController(channels=(4, 8, 8), features=16, hidden=8)
    batch = {"goal": torch.zeros(1, 1, 4), "label": torch.full((1, 1, 2), 0.7)}
    output = controller(
        torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8), torch.zeros(1, 1, controller.proprio_size),
        torch.zeros(1, 1, dtype=torch.int64), torch.zeros(1, 1, dtype=torch.bool), controller.initial_memory(1),
    )  # fmt: skip

    def action_loss(kind: GoalKind, instruction: Instruction) -> float:
        batch["kind"], batch["instruction"] = torch.tensor([[kind]]), torch.tensor([[instruction]])
        return float(imitation_loss(output, GoalHead(24), batch, config)[1]["loss/action"])

    full = action_loss(GoalKind.PUSH, Instruction.NORTH)
    assert action_loss(GoalKind.HOLD, Instruction.NORTH) == pytest.approx(0.25 * full)
    assert action_loss(GoalKind.HOLD, Instruction.STAY) == pytest.approx(full)


def test_a_teacher_without_distillation_is_refused():
    with pytest.raises(ValueError, match="only the stage distil"):
        TrainConfig(stage="mpo", teacher=Path("teacher.safetensors"))
