"""Players: some robots of a training act as the product will, without noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mujoban_baselines.joint.stack import DrawingController
from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.play import (
    CRITIC,
    CRITIC_FIELDS,
    CriticDraw,
    Draw,
    ExploringPlayer,
    Player,
    PrivilegedPlayer,
    ReplaySource,
)
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_rl.engine import State
from mujoban_sim.oracles import OraclePlanner


@pytest.fixture
def task():
    config = GoalTaskConfig(batch=4, difficulty=1)
    task = GoalTask(config, OraclePlanner(), SeededEpisodes(1, 5_000_000), np.random.default_rng(0))
    yield task
    task.world.close()


def by_the_mean(action, mean):
    return (np.abs(action - np.clip(mean, -1, 1)) < 1e-6).all(-1).tolist()


def test_steady_robots_of_a_teacher_play_by_the_mean_and_every_third_explores(task):
    policy = PrivilegedPolicy("ball", scale=0.4)
    player = PrivilegedPlayer(task, policy, torch.Generator().manual_seed(0), explore=1e3, steady=0.5)
    player.take(policy.state_dict())
    kept, _ = player.tick()
    assert by_the_mean(kept["action"], policy.act(kept["features"])) == [False, True, False, True]
    assert (np.abs(kept["action"]) == 1.0).all(-1).tolist() == [True, False, False, False]


def test_steady_robots_of_a_camera_policy_do_not_explore_and_their_values_are_those_of_the_mean(task):
    policy = VisuomotorController("ball", channels=(8, 8, 8), features=16, hidden=8)
    player = ExploringPlayer(task, policy, torch.Generator().manual_seed(0), explore=0.5, steady=0.5)
    kept, _ = player.tick()
    assert by_the_mean(kept["action"], kept["mean"]) == [False, True, False, True]
    assert (kept["scale"] > 0).all(-1).tolist() == [True, False, True, False]


def test_steady_robots_of_a_stack_that_is_fine_tuned_play_by_the_mean(task):
    network, inputs = VisuomotorController("ball", channels=(8, 8, 8), features=16, hidden=8), task.observe()
    controller = DrawingController(network, torch.Generator().manual_seed(0), explore=0.5, steady=0.5)
    torque, _ = controller.step(inputs, controller.initial_memory(4))
    with torch.no_grad():
        output = network(*network.to_tensors(inputs), memory=Recurrent(*network.initial_memory(4)))
    assert by_the_mean(torque, output.action.mean[:, 0].numpy()) == [False, True, False, True]


class Counter(Player):
    """Says in every field which tick it is."""

    now = 0

    def tick(self):
        self.now += 1
        return {name: np.full((2, 1), self.now, np.float32) for name in CRITIC_FIELDS}, []

    def take(self, weights):
        """Play on."""

    def state(self):
        return State({"now": self.now})

    def restore(self, state):
        self.now = state.values["now"]

    def close(self):
        """Hold nothing."""


def test_critics_windows_begin_at_every_tick_that_was_played():
    critic = CriticDraw(capacity=64, window=6, updates=2, windows=4)
    draw = Draw(capacity=64, length=16, window=16, windows=1, per_tick=1.0, first=48, critic=critic)
    source = ReplaySource(Counter(), draw, torch.Generator().manual_seed(0))
    begun = set()
    for batch in range(200):
        if batch == 20:  # goes on from a checkpoint
            state, source = source.state(), ReplaySource(Counter(), draw, torch.Generator())
            source.restore(state)
        windows = source.next_batch()[CRITIC + "reward"]
        assert windows.shape == (2, 4, 6, 1)
        begun |= set(windows[..., 0, 0].flatten().long().tolist())
    assert len(begun & set(range(1, 150))) > 140, "but for those that were not drawn, all"
