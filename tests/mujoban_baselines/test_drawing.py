"""Agents that draw their torques in play, as they explored."""

import numpy as np
import pytest
import torch

from mujoban_baselines import load
from mujoban_baselines.agents import MonolithicAgent
from mujoban_baselines.drawing import Drawing
from mujoban_core.agent import AgentInput
from mujoban_core.interfaces import renew_rows, take_rows
from mujoban_core.plugins import load_module
from mujoban_rl.weights import save_weights


@pytest.fixture
def agent():
    torch.manual_seed(0)
    return MonolithicAgent(repeat=4, draws="pink").eval()


def alike(count):
    """The same sight for every robot."""
    rng = np.random.default_rng(0)
    frame, felt, pose = rng.integers(0, 255, (1, 64, 64, 3), np.uint8), rng.normal(size=(1, 16)), np.zeros((1, 3))
    return AgentInput(*(np.repeat(x.astype(t), count, 0) for x, t in ((frame, "u1"), (felt, "f4"), (pose, "f4"))))


def test_torques_are_drawn_from_the_policy_and_resemble_those_before(agent):
    drawing = Drawing(agent, "pink")
    state = drawing.initial_state(np.arange(256))
    policy, _ = agent.respond(alike(256), agent.initial_state(np.arange(256)))
    with torch.no_grad():
        # Far from the limits, where nothing is cut off.
        agent.mean.bias -= policy.mean[0]
        agent.scale.bias -= 3.0
        policy, _ = agent.respond(alike(256), agent.initial_state(np.arange(256)))
    before, state = drawing.step(alike(256), state)
    after, _ = drawing.step(alike(256), state)
    assert np.allclose(before.std(0), policy.scale[0], rtol=0.15), "by the policy's own scale"
    assert (abs(before.mean(0) - policy.mean[0].numpy()) < 0.2 * before.std(0)).all()
    assert 0.5 < np.corrcoef(before[:, 0], after[:, 0])[0, 1] < 0.95, "noise that drives the robot about"
    assert abs(np.corrcoef(before[:, 0], before[:, 1])[0, 1]) < 0.2


def test_what_a_robot_draws_rests_on_its_own_seed_alone(agent):
    drawing = Drawing(agent, "white")
    fresh = drawing.initial_state(np.array([5, 6, 7]))
    first, state = drawing.step(alike(3), fresh)
    alone, _ = drawing.step(alike(1), take_rows(fresh, np.array([1])))
    assert np.allclose(alone[0], first[1], atol=1e-6) and not np.allclose(first[0], first[1], atol=1e-3)
    again, _ = drawing.step(alike(3), renew_rows(state, fresh, np.array([False, True, False])))
    assert np.allclose(again[1], first[1], atol=1e-6) and not np.allclose(again[0], first[0], atol=1e-3)


def test_weights_say_that_they_are_played_so(agent, tmp_path):
    save_weights(tmp_path / "agent.safetensors", agent, agent.config, {})
    played = load(tmp_path / "agent.safetensors")
    state, torques = played.initial_state(np.arange(2)), []
    for _ in range(8):
        torque, state = played.step(alike(2), state)
        torques.append(torque)
    assert [i for i in range(1, 8) if not np.array_equal(torques[i], torques[i - 1])] == [4]
    assert not np.allclose(torques[0][0], torques[0][1], atol=1e-3), "both see the same, and draw for themselves"
    with pytest.raises(ValueError, match="exploration 'brown': expected one of pink, white"):
        MonolithicAgent(draws="brown")


def test_the_floor_is_the_noise_of_an_agent_that_knows_nothing():
    one, other = (load_module("agent", "mujoban_baselines.agents:untrained") for _ in range(2))
    seeds = np.arange(256)
    torques = np.array([one.step(alike(256), one.initial_state(seeds))[0] for one in (one, other)])
    assert np.array_equal(*torques), "the same weights each time"
    assert abs(torques[0].mean(0)).max() < 0.1 and torques[0].std(0) == pytest.approx([0.45, 0.45], abs=0.05)
    state, held = one.initial_state(seeds), []
    for _ in range(5):
        torque, state = one.step(alike(256), state)
        held.append(torque)
    assert [i for i in range(1, 5) if not np.array_equal(held[i], held[i - 1])] == [4]
