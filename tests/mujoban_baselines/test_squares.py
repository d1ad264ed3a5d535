"""The golden task: what agents see of it is a level, so that subgoals can be reached."""

import numpy as np

from mujoban_baselines.actor import make_actor
from mujoban_baselines.agents import StructuredAgent
from mujoban_baselines.squares import SquaresTask
from mujoban_core.grid import AGENT, BOX, TARGET, WALL


def test_its_map_is_a_room_with_a_robot_a_target_and_a_box():
    task = SquaresTask(np.random.default_rng(0), batch=64)
    for _ in range(20):
        task.renew(np.flatnonzero(task.step(np.random.default_rng(1).uniform(-1, 1, (64, 2)).astype(np.float32)).over))
        state = task.observe(("abstract_state",))["abstract_state"]
        assert (state[..., WALL].sum((1, 2)) == 36).all(), "the border"
        for layer in (AGENT, TARGET, BOX):
            assert (state[..., layer].sum((1, 2)) == 1).all() and not (state[..., layer] * state[..., WALL]).any()


def test_an_episode_that_ended_stands_still_until_it_is_renewed():
    task = SquaresTask(np.random.default_rng(0), batch=64)
    torque = np.random.default_rng(1).uniform(-1, 1, (64, 2)).astype(np.float32)
    ended, outcome = np.zeros(64, np.bool_), np.zeros(64)
    for _ in range(60):  # longer than an episode
        before = task.observe(("pose",))["pose"]
        step = task.step(torque)
        assert (step.reward[ended] == 0.0).all() and step.over[ended].all()
        assert np.array_equal(task.observe(("pose",))["pose"][ended], before[ended])
        outcome[~ended] = np.sign(np.where(step.terminated, step.reward, 0.0))[~ended]
        ended |= step.over
    assert ended.all() and (outcome > 0).any() and (outcome == 0).any()
    assert task.renew(np.arange(64))["solved"] == (outcome > 0).astype(float).tolist()


def test_a_walker_reaches_subgoals_by_chance():
    actor = make_actor(_task, StructuredAgent, 41, 1, (), "white", 0, 0)
    assert actor.act().arrays["pseudo_reward"].sum() > 0.2, "a tenth for each"


def _task(rng):
    return SquaresTask(rng, batch=4)
