"""Agents that hold their torques for some ticks, in play and in training alike."""

import numpy as np
import pytest
import torch

from bringup.rollout import ticks
from mujoban_baselines import load
from mujoban_baselines.actor import AgentActor
from mujoban_baselines.agents import MonolithicAgent, TopDownAgent
from mujoban_baselines.repeat import Repeating
from mujoban_baselines.task import Task, TaskStep
from mujoban_core.agent import Agent, AgentInput, AgentPolicy
from mujoban_core.interfaces import renew_rows
from mujoban_core.plugins import check_body
from mujoban_rl.weights import save_weights
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


class Counting(Agent):
    """Says how often each robot was asked, and what it saw last."""

    sees = ("pose",)

    def initial_memory(self, batch):
        return (np.zeros(batch, np.int64),)

    def step(self, inputs, state):
        return np.stack([state[0], inputs.pose[:, 0]], -1).astype(np.float32), (state[0] + 1,)


def pose(*x):
    return AgentInput(pose=np.array([[value, 0, 0] for value in x], np.float32))


def test_torques_are_held_and_each_robot_is_asked_by_the_ticks_of_its_own_episode():
    agent = Repeating(Counting(), 3, actuators=2)
    fresh = agent.initial_state(np.arange(2))
    state, torques = fresh, []
    for tick in range(5):
        torque, state = agent.step(pose(tick, 10 + tick), state)
        torques.append(torque.tolist())
    assert torques == [[[0, 0], [0, 10]]] * 3 + [[[1, 3], [1, 13]]] * 2
    state = renew_rows(state, fresh, np.array([False, True]))
    torque, state = agent.step(pose(5, 15), state)
    assert torque.tolist() == [[1, 3], [0, 15]]
    torque, state = agent.step(pose(6, 16), state)
    assert torque.tolist() == [[2, 6], [0, 15]]


def test_weights_are_played_as_they_were_trained(tmp_path):
    agent = MonolithicAgent(repeat=4).eval()
    save_weights(tmp_path / "agent.safetensors", agent, agent.config, {})
    played, rng = load(tmp_path / "agent.safetensors"), np.random.default_rng(0)
    state, torques = played.initial_state(np.arange(2)), []
    for _ in range(8):
        inputs = AgentInput(
            frame=rng.integers(0, 255, (2, 64, 64, 3), np.uint8), proprio=rng.normal(size=(2, 16)).astype(np.float32),
            pose=rng.normal(size=(2, 3)).astype(np.float32),
        )  # fmt: skip
        torque, state = played.step(inputs, state)
        torques.append(torque)
    changed = [i for i in range(1, 8) if not np.array_equal(torques[i], torques[i - 1])]
    assert changed == [4] and not played.privileged
    with pytest.raises(ValueError, match="was trained for the body ball: expected weights for ant"):
        check_body("agent", played, "ant")
    with pytest.raises(ValueError, match="repeat is 0: expected at least 1"):
        MonolithicAgent(repeat=0)


@pytest.mark.parametrize(("kind", "camera"), [(MonolithicAgent, True), (TopDownAgent, False)])
def test_frames_that_nobody_looks_at_are_not_drawn(kind, camera, monkeypatch):
    torch.manual_seed(0)
    policy = AgentPolicy(Repeating(kind(repeat=4).eval(), 4, actuators=2))
    render, drawn, played = World.render, [], []
    monkeypatch.setattr(World, "render", lambda *args, rows: drawn.append(len(rows)) or render(*args, rows=rows))
    for drawing in (None, camera):
        world = World(2, max_boxes=1, time_limit=6)
        told = [tick.decision.torque for tick in ticks(policy, world, Episodes(3, 20, difficulty=1), camera=drawing)]
        played.append((np.concatenate(told), sum(drawn)))
        drawn.clear()
        world.close()
    assert np.array_equal(played[0][0], played[1][0])
    # In three episodes of 6 ticks: what two decisions rest on, or all ticks, and what is there behind the last.
    assert [frames for _, frames in played] == [3 * (2 + 1), 3 * (6 + 1)]


class Tape(Task):
    """One tick, one reward: 1, 2, 3, ...; episodes of 6 ticks end inside of what an agent of 4 ticks decides."""

    batch = 2

    def __init__(self):
        self.tick, self.age, self.torques = 0, 0, []

    def observe(self, names):
        shapes = {"frame": (64, 64, 3), "proprio": (16,), "pose": (3,)}
        return {name: np.zeros((2, *shapes[name]), np.uint8 if name == "frame" else np.float32) for name in names}

    def step(self, torque):
        self.torques.append(torque)
        self.tick, self.age = self.tick + 1, self.age + 1
        return TaskStep(np.full(2, self.tick, np.float32), np.zeros(2, np.bool_), np.full(2, self.age == 6))

    def renew(self, rows):
        self.age = 0
        return {"lasted": [1.0] * len(rows)}


def test_what_is_learned_from_is_a_decision_and_what_it_led_to():
    torch.manual_seed(0)
    task = Tape()
    actor = AgentActor(task, MonolithicAgent(repeat=4), length=3, overlap=1, exploration="pink")
    experience = actor.act()
    assert experience.steps == 3 * 4 * 2, "environment steps of both robots"
    assert experience.arrays["reward"][:, 0].tolist() == [1 + 2 + 3 + 4, 5 + 6, 9 + 10 + 11 + 12]
    assert experience.arrays["truncated"][:, 0].tolist() == [False, True, False]
    held = np.array(task.torques)
    assert all((held[i] == held[i - i % 4]).all() for i in range(12)) and len({t.tobytes() for t in held}) == 3
