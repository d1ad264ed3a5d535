"""A body that only a description makes is trained and judged."""

from __future__ import annotations

import numpy as np
import pytest
from cart import CART

from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_controller.ppo import PPOTrainingConfig
from mujoban_controller.train import Options, TrainConfig, make_trainer
from mujoban_core.bodies import BODIES


@pytest.mark.parametrize("algorithm", ["ppo", "mpo"])
def test_a_body_that_was_never_heard_of_is_trained_and_judged(monkeypatch, algorithm, tmp_path):
    monkeypatch.setitem(BODIES, "cart", CART)
    config = TrainConfig(
        stage="teacher", algorithm=algorithm, steps=512,
        task=GoalTaskConfig(batch=8, body="cart", world="reference", difficulty=1),
        ppo=PPOTrainingConfig(length=16, minibatch=64),
        mpo=MPOTrainingConfig(windows=8, sequence=8, replay=256, first=128, reuse=1.0),
    )  # fmt: skip
    trainer = make_trainer(Options(tmp_path, config, evaluation_episodes=0))
    world = trainer.source.task.world if algorithm == "ppo" else trainer.source.player.task.world
    start = world.pose.copy()
    assert trainer.run() and trainer.progress.samples >= 512
    assert np.abs(world.pose - start)[:, :2].max() > 0.01 and np.isfinite(world.proprio).all()
    assert (tmp_path / "teacher.safetensors").exists()
