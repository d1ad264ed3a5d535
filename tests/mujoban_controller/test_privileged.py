"""Privileged policies: what symmetric bodies see, and the policy as a controller of the stack."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_features import feature_layout
from mujoban_controller.goal_settings import judging_config
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.privileged_controller import PrivilegedController
from mujoban_core.bodies import ANT, BALL, BODIES
from mujoban_core.interfaces import renew_rows
from mujoban_rl.networks import Normaliser
from mujoban_sim.goals import GoalKind
from mujoban_sim.oracles import OraclePlanner


def wild_policy(body):
    """Return a policy whose actions depend on what it sees from the first tick on."""
    torch.manual_seed(0)
    policy = PrivilegedPolicy(body)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(60.0)
    return policy


def make(body, batch=3):
    config = judging_config(batch, body, 2, world="reference")
    return GoalTask(config, OraclePlanner(), SeededEpisodes(2, 10_000_000), np.random.default_rng(0))


@pytest.mark.parametrize("name", sorted(BODIES))
def test_as_a_controller_it_does_what_it_does_in_the_goal_task(name):
    task, policy = make(name), wild_policy(name)
    controller = PrivilegedController(policy)
    driver, memory = policy.driver(), controller.initial_memory(3)
    rows, before = np.arange(3), task.world.box_position.copy()
    for _ in range(130):
        memory = renew_rows(memory, controller.initial_memory(3), task.first)
        torque, memory = controller.step(task.observe(camera=False), memory)
        expected = driver(task)
        # A box's speed follows from where it was a tick ago, so it is not exact while one moves.
        moved = np.abs(task.world.box_position - before).max(-1)[rows, task.world.goals.box_index] > 1e-5
        moved |= task.world.box_speed[rows, task.world.goals.box_index] > 1e-3
        still = ~((task.world.goals.kind == GoalKind.PUSH) & moved)
        before = task.world.box_position.copy()
        np.testing.assert_allclose(torque[still], expected[still], atol=1e-4)
        task.step(torque)


@pytest.mark.parametrize("body", [ANT, BALL], ids=lambda b: b.name)
def test_mirroring_twice_changes_nothing(body):
    layout = feature_layout(body)
    for mirror in (layout.mirror, layout.mirror_action):
        assert np.array_equal(mirror.source[mirror.source], np.arange(len(mirror.source)))
        assert (mirror.sign * mirror.sign[mirror.source] == 1.0).all()


def test_features_are_normalised_by_all_samples_seen():
    normaliser, x = Normaliser(3), torch.randn(500, 3) * 4.0 + 2.0
    for part in x.split(77):
        normaliser.update(part)
    assert torch.allclose(normaliser.mean, x.mean(0), atol=1e-4)
    assert torch.allclose(normaliser(x).std(0), torch.ones(3), atol=0.05)
