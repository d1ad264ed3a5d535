"""Where to look before pushing: the grid model of what a camera sees, and the policy that learns in it."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from cart import CART

from bringup import evaluate
from bringup.command import Choice
from mujoban_core.bodies import ANT, BALL, BODIES
from mujoban_core.files import digest
from mujoban_core.grid import AGENT, BOX, WALL, Instruction
from mujoban_core.look_around import WALKS, LookAroundPlanner, Scout
from mujoban_core.plugins import LEARNED, SCOUT, PluginError, load_scout
from mujoban_planner.boards import abstract_states
from mujoban_planner.exploration_env import SHOWN, ExplorationEnvironment, ExplorationReward
from mujoban_planner.exploration_mpo import ExplorerConfig, explore, judge_scout
from mujoban_planner.explorer import Explorer
from mujoban_planner.uncertainty import visible
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import save_weights
from mujoban_sim.oracles import OraclePlanner
from mujoban_sokoban.levels import Level, stack_levels

CORNER = """
##########
#@   #####
####   ###
####   ###
####   ###
####.$ ###
####   ###
##########
##########
##########
"""
"""A corridor to the east that ends in a room, of which the start shows a corner at most."""


@pytest.fixture
def environment():
    states = abstract_states(stack_levels([Level.from_text(CORNER.strip())]))
    reward = ExplorationReward(cell=1.0, move=0.25, look=0.5)
    return ExplorationEnvironment(states, np.random.default_rng(0), BALL, reward)


def test_the_camera_of_the_body_says_what_comes_into_view():
    states = abstract_states(stack_levels([Level.from_text(CORNER.strip())]))
    narrow = dataclasses.replace(CART, camera=dataclasses.replace(CART.camera, fovy=20.0))
    first, gained = {}, {}
    for body in (ANT, CART, narrow):
        environment = ExplorationEnvironment(states, np.random.default_rng(0), body)
        first[body] = environment.seen.copy()
        for _ in range(3):
            environment.step(np.array([int(Instruction.EAST)]))
        gained[body] = environment.seen.sum() - first[body].sum()
    # The cart is as small as its cells and sees as wide as the ant; a narrow view makes a whole turn all the same.
    assert gained[ANT] == gained[CART] > gained[narrow]
    assert (first[ANT] == first[CART]).all() and (first[ANT] == first[narrow]).all()


def test_what_lies_behind_walls_is_a_guess_until_it_comes_into_view(environment):
    truth = environment.level[0]
    hidden = visible(environment.level)[0] & ~environment.seen[0]
    assert hidden[5, 5] and truth[5, 5, BOX] and not hidden[1, 4]
    state = environment.observe()[0]
    assert 0.0 < state[5, 5, BOX] < 1.0 and 0.0 < state[5, 5, WALL] < 1.0
    assert (state[~hidden & visible(environment.level)[0]][:, WALL] % 1.0 == 0.0).all()
    assert state[1, 1, AGENT] == 1.0 and state[..., AGENT].sum() == 1.0


def test_cells_that_come_into_view_are_rewarded_once_and_steps_cost(environment):
    east, south, stay = (np.array([int(i)]) for i in (Instruction.EAST, Instruction.SOUTH, Instruction.STAY))
    assert environment.step(stay).reward == -0.5  # the start has been looked at
    assert environment.step(south).reward == -0.25 and environment.agent.tolist() == [[1, 1]]  # a wall
    gained = [float(environment.step(east).reward[0]) for _ in range(3)]
    before = environment.seen.sum()
    gained.append(float(environment.step(stay).reward[0]))
    assert gained[-1] == environment.seen.sum() - before - 0.5 > 0
    last = environment.step(stay)
    assert environment.seen[0, 1, 5] and last.reward == -0.5
    assert not last.complete[0] and environment.remaining[0] > 0


def test_an_explorer_steps_only_where_it_believes_the_way_is_free(environment):
    torch.manual_seed(0)
    explorer = Explorer(8, 1)
    seen = environment.observe()[0]
    told = explorer(torch.from_numpy(seen[None]))
    possible = [True, False, True, False, False]
    assert [(x[0] > -1000.0).tolist() for x in told] == [possible, possible]
    with torch.no_grad():
        # Whoever goes by what a turn shows walks along the corridor, if it is worth anything.
        explorer.places.weight[:, -2] += 100.0
        explorer.places.bias[:] = 0.0
    assert explorer.step(seen[..., :SHOWN], seen[..., SHOWN] > 0.5) == Instruction.EAST
    with torch.no_grad():
        explorer.places.bias[1::2] = -10_000.0
    assert explorer.step(seen[..., :SHOWN], seen[..., SHOWN] > 0.5) is None


def test_a_planner_looks_where_its_scout_says(environment):
    class Eastward(Scout):
        def step(self, abstract_state, shown):
            assert shown[1, 1]
            return Instruction.EAST if abstract_state[1, 1, AGENT] else None

    planner = LookAroundPlanner(OraclePlanner(), 1, scout=Eastward())
    truth = environment.level.astype(np.float32)
    state = planner.initial_state(np.zeros(1, np.int64))
    said = []
    for _ in range(2):
        instruction, state = planner.step(truth, np.ones(1, np.bool_), state)
        said.append(int(instruction[0]))
    assert said == [Instruction.STAY, Instruction.EAST]


def small(path, **changes):
    config = ExplorerConfig(
        channels=8, blocks=1, environments=8, batch_size=16, warm_up_steps=15, replay_steps=60, play=5, n_step=3,
        levels=16, cpu_seconds=1e9, updates=12,  # so that the learning rate follows updates, not this machine
        **changes,
    )  # fmt: skip
    return explore(config, path)


def test_runs_resume_to_the_bit_and_leave_an_explorer(tmp_path, monkeypatch):
    monkeypatch.setattr("mujoban_planner.exploration_mpo._JUDGED", 4)
    check_resuming(lambda path: small(path, target_period=2), tmp_path, stop_at=3, updates=6)
    assert (tmp_path / "whole" / "explorer.safetensors").exists()


def test_an_explorer_of_any_body_is_trained_and_scouts_for_that_body_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("mujoban_planner.exploration_mpo._JUDGED", 4)
    monkeypatch.setitem(BODIES, "cart", CART)
    assert small(tmp_path, body="cart").run()
    weights = tmp_path / "explorer.safetensors"
    assert isinstance(load_scout(LEARNED, weights, body="cart"), Explorer)
    with pytest.raises(ValueError, match="scout was trained for the body cart: expected weights for ball"):
        load_scout(LEARNED, weights, body="ball")


def test_a_scout_takes_what_it_sees_to_the_device_of_its_network(environment):
    explorer, seen = Explorer(8, 1).to("meta"), environment.observe()[0]

    class Reached(Exception):
        pass

    def look(module, inputs):
        raise Reached(inputs[0].device.type)

    explorer.register_forward_pre_hook(look)
    with pytest.raises(Reached, match="meta"):
        explorer.step(seen[..., :SHOWN], seen[..., SHOWN] > 0.5)


def test_a_learned_scout_without_weights_says_that_none_ship():
    with pytest.raises(PluginError, match=r"learned scout: none of its weights ship, expected some \(\.safe"):
        load_scout(LEARNED)
    with pytest.raises(PluginError, match="the learned scout: none of its weights ship"):
        Choice(SCOUT, LEARNED).identity()


def test_a_batch_with_nan_is_refused(tmp_path):
    check_refusal(small(tmp_path), lambda batch: batch._replace(reward=batch.reward * math.nan))


def test_looking_pays_where_it_is_rewarded(monkeypatch):
    class Never(Scout):
        def step(self, abstract_state, shown):
            return None

    class Turns(Scout):
        def step(self, abstract_state, shown):
            return Instruction.STAY

    reward = ExplorationReward()
    assert judge_scout(Never(), reward, 4, BALL) == {"found": 0.0, "steps": 0.0, "looks": 0.0, "reward": 0.0}
    # Whoever never stops is stopped, also where all has been seen.
    monkeypatch.setattr(ExplorationEnvironment, "remaining", property(lambda self: np.zeros(4, np.int64)))
    assert judge_scout(Turns(), reward, 4, BALL)["looks"] == WALKS


def test_a_learned_scout_plays_and_is_named_by_its_weights(tmp_path):
    path, weights = tmp_path / "report.json", tmp_path / "explorer.safetensors"
    explorer = Explorer(8, 1)
    save_weights(weights, explorer, explorer.config, {})
    options = ["--difficulty", "1", "--episodes", "2", "--time-limit", "90", "--seed", "5000007"]
    oracles = ["--oracle", "planner,controller,termination"]
    assert evaluate.main([*options, *oracles, "--scout", str(weights), "--json", str(path)]) == 0
    assert json.loads(path.read_text())["weights"]["scout"] == digest(weights)
