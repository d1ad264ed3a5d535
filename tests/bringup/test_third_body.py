"""A body that only a description makes is recorded, sensed, driven by camera and played, as the two that ship are."""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np
import pytest
import torch
from cart import CART
from gymnasium.utils.env_checker import check_env

import mujoban_controller
import mujoban_sim  # noqa: F401 - registers the environment
from bringup.command import Choice, Stack
from bringup.evaluate import evaluate
from bringup.exploration import Disturbance
from bringup.options import PlayerOptions
from bringup.record import Job, MixedEpisodes, record
from mujoban_controller.distil import DistilConfig
from mujoban_controller.evaluate import Options as Judged
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.train import NetworkConfig
from mujoban_controller.train import Options as ControllerOptions
from mujoban_controller.train import TrainConfig as ControllerConfig
from mujoban_controller.train import make_trainer as controller_trainer
from mujoban_core.bodies import BALL, BODIES
from mujoban_core.plugins import ROLES
from mujoban_estimator.estimator import EstimatorConfig
from mujoban_estimator.learner import LearnerConfig, TrainConfig
from mujoban_estimator.termination import TerminationConfig
from mujoban_estimator.train import Options, make_trainer
from mujoban_planner.explorer import Explorer
from mujoban_rl.weights import save_weights
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import TRAIN_SEEDS


@pytest.fixture
def teacher(monkeypatch, tmp_path):
    """Make the cart a body, and return weights of an untrained teacher of it."""
    monkeypatch.setitem(BODIES, "cart", CART)
    torch.manual_seed(0)
    policy = PrivilegedPolicy("cart")
    save_weights(tmp_path / "teacher_cart.safetensors", policy, policy.config, {})
    return tmp_path / "teacher_cart.safetensors"


def test_libraries_take_its_environment(teacher):
    env = gymnasium.make("Mujoban-v0", difficulty=1, body="cart", time_limit=20)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.action_space.shape == (2,)


def test_commands_drive_it_by_its_teacher_as_oracle_or_say_which_weights_are_missing(teacher, monkeypatch, tmp_path):
    options = PlayerOptions(oracle=",".join(ROLES))
    for asked in (options, PlayerOptions(controller="oracle")):
        with pytest.raises(ValueError, match=r"drives the body cart: expected .*/weights/teacher_cart\.safetensors"):
            asked.player("cart")
    monkeypatch.setattr(mujoban_controller, "_WEIGHTS", tmp_path)
    stack = options.stack("cart")
    assert stack.choices["controller"].weights == teacher
    (result,) = evaluate(stack.policy(), Episodes(1, 5_000_000, difficulty=1), body="cart", batch=1, time_limit=5)
    assert result.steps == 5


def test_a_body_is_driven_by_script_where_its_description_says_so(teacher, monkeypatch):
    with pytest.raises(ValueError, match="no script drives --body cart"):
        Judged(driver="scripted", body="cart")
    monkeypatch.setitem(BODIES, "cart", dataclasses.replace(CART, scripted=True))
    monkeypatch.setitem(BODIES, "ball", dataclasses.replace(BALL, scripted=False))
    assert Judged(driver="scripted", body="cart").body == "cart"
    policy = PlayerOptions(oracle=",".join(ROLES)).player("cart").policy()
    (result,) = evaluate(policy, Episodes(1, 5_000_000, difficulty=1), body="cart", batch=1, time_limit=5)
    assert result.steps == 5


def test_its_senses_and_its_camera_policy_are_trained_and_play_in_the_graph(teacher, oracles, play_graph, tmp_path):
    driven = Stack(oracles.choices | {"controller": Choice("controller", weights=teacher)}, body="cart")
    episodes = MixedEpisodes(2, TRAIN_SEEDS.start, [1])
    assert record(Job(tmp_path / "bags", "", episodes, driven, Disturbance(), 2, 40, 0)) == 80
    senses = LearnerConfig(EstimatorConfig(body="cart"), TerminationConfig(body="cart"))
    sensed = TrainConfig(senses, steps=2, streams=2, length=16)
    options = Options((tmp_path / "bags",), tmp_path / "senses", out=tmp_path / "out", config=sensed, workers=0)
    make_trainer(options).run()
    task = GoalTaskConfig(batch=4, body="cart", difficulty=1)
    config = ControllerConfig(
        stage="distil", teacher=teacher, task=task, network=NetworkConfig((8, 8), 16, 16), steps=256,
        distil=DistilConfig(windows=4, first=64),
    )  # fmt: skip
    controller_trainer(ControllerOptions(tmp_path / "student", config, evaluation_episodes=0)).run()
    learned = {
        "estimator": Choice("estimator", weights=tmp_path / "out/estimator.safetensors"),
        "termination": Choice("termination", weights=tmp_path / "out/termination.safetensors"),
        "controller": Choice("controller", weights=tmp_path / "student/controller.safetensors"),
    }
    scout = tmp_path / "explorer.safetensors"
    explorer = Explorer(8, 1, body="cart")
    save_weights(scout, explorer, explorer.config, {})
    stack = Stack(oracles.choices | learned, look_around=5, body="cart", scout=Choice("scout", weights=scout))
    graph = play_graph(stack, Episodes(1, 0, difficulty=1), time_limit=30)
    (result,) = graph.finish()
    torques = np.array(list(graph.said.torque.values()))
    assert result.steps == len(torques) == 30 and torques.shape[1] == 2 and np.abs(torques).max() > 0
