"""A body that only a description makes: nothing knows bodies by name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_controller.ppo import PPOTrainingConfig
from mujoban_controller.train import Options, TrainConfig, make_trainer
from mujoban_core.bodies import ANT, BODIES, Body, Motor, Relabelling, Symmetry

CART = Body(
    name="cart",
    root="free",
    joints=("left", "right"),
    joint_qpos=(7, 8),
    joint_qvel=(6, 7),
    joint_range=(None, None),
    symmetry=Symmetry(Relabelling((1, 0), (1.0, 1.0))),
    actuators=(Motor("left", 0.5), Motor("right", 0.5)),
    rest_qpos=(0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    cell_size=0.5,
    time_limit=1000,
    camera=dataclasses.replace(ANT.camera, height=0.3),
    mjcf="""
    <body name="robot" pos="0 0 0.1"><freejoint name="root"/><site name="imu"/>
      <camera name="first_person" pos="0 0 0.2" xyaxes="0 -1 0 0 0 1"/>
      <geom class="robot" type="box" size="0.1 0.06 0.03" mass="3"/>
      <geom class="robot" type="sphere" size="0.05" pos="-0.08 0 -0.05" mass="0.1" friction="0.01 0.005 0.0001"/>
      <body name="left" pos="0 0.08 0"><joint name="left" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom class="robot" type="cylinder" size="0.1 0.01" euler="90 0 0" mass="0.2"/></body>
      <body name="right" pos="0 -0.08 0"><joint name="right" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom class="robot" type="cylinder" size="0.1 0.01" euler="90 0 0" mass="0.2"/></body>
    </body>""",
)
"""Two driven wheels and a caster."""


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
