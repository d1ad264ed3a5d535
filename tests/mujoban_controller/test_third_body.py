"""A body that only a description makes is trained and judged."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from cart import CART

from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.mpo import AsymmetricConfig, MPOTrainingConfig
from mujoban_controller.ppo import PPOTrainingConfig
from mujoban_controller.train import NetworkConfig, Options, TrainConfig, make_trainer
from mujoban_core.bodies import BODIES
from mujoban_rl.metrics import read_metrics
from mujoban_rl.weights import read_record

TASK = GoalTaskConfig(batch=8, body="cart", world="reference", difficulty=1)
MPO: dict[str, Any] = dict(windows=8, sequence=8, replay=256, first=128, reuse=1.0)
STAGES = {
    "ppo": TrainConfig(stage="teacher", algorithm="ppo", task=TASK, ppo=PPOTrainingConfig(length=16, minibatch=64)),
    "mpo": TrainConfig(stage="teacher", algorithm="mpo", task=TASK, mpo=MPOTrainingConfig(**MPO)),
    "asymmetric": TrainConfig(
        stage="mpo", task=TASK, network=NetworkConfig((8, 8), 16, 8), asymmetric=AsymmetricConfig(**MPO)
    ),
}


@pytest.mark.parametrize("stage", STAGES)
def test_a_body_that_was_never_heard_of_is_trained_and_judged(monkeypatch, stage, tmp_path):
    monkeypatch.setitem(BODIES, "cart", dataclasses.replace(CART, time_limit=20))
    config = dataclasses.replace(STAGES[stage], steps=512)
    trainer = make_trainer(Options(tmp_path, config, evaluation_episodes=1, evaluate_every=512))
    world = trainer.source.task.world if stage == "ppo" else trainer.source.player.task.world
    start = world.pose.copy()
    assert trainer.run() and trainer.progress.samples >= 512
    assert np.abs(world.pose - start)[:, :2].max() > 0.01 and np.isfinite(world.proprio).all()
    product = tmp_path / f"{'controller' if stage == 'asymmetric' else 'teacher'}.safetensors"
    assert read_record(product)["config"]["body"] == "cart"
    assert any("evaluation/success_rate" in line for line in read_metrics(tmp_path))
