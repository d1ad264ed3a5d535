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


def test_a_walker_reaches_subgoals_by_chance():
    actor = make_actor(_task, StructuredAgent, 41, 1, (), "white", 0, 0)
    assert actor.act().arrays["pseudo_reward"].sum() > 0.2, "a tenth for each"


def _task(rng):
    return SquaresTask(rng, batch=4)
