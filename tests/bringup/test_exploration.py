"""Disturbed recordings: what the stack does, and more."""

import numpy as np
import pytest

from bringup.exploration import Disturbance, DisturbedController, DisturbedPlanner, disturbed
from bringup.rollout import ticks
from mujoban_core.bodies import BODIES
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Controller, ControllerInput, Planner
from mujoban_core.look_around import look_around
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

NONE = Disturbance(wander=0, stray=0, infeasible=0, delay=0, early=0, shaky=0, max_noise=0, spin=0, spin_again=0)
LOOK = 8


def stack():
    parts = OracleEstimator(), OracleTermination(), OraclePlanner(), OracleController()
    return SensePlanAct(*(look_around(part, LOOK) for part in parts))  # pyright: ignore


def instructions(policy, count=400):
    played = ticks(policy, World(1, max_boxes=3), Episodes(1, 7, difficulty=3))
    return [int(tick.decision.instruction[0]) for tick, _ in zip(played, range(count), strict=False)]


def test_a_stack_that_looks_around_does_the_same_where_nothing_disturbs_it():
    rng = np.random.default_rng(0)
    undisturbed = instructions(stack())
    assert len(set(undisturbed[LOOK:])) > 2 and instructions(disturbed(stack(), NONE, rng)) == undisturbed


def test_in_an_episode_of_random_walks_the_robot_looks_first_and_then_wanders():
    rng = np.random.default_rng(0)
    walked = instructions(disturbed(stack(), Disturbance(wander=1.0), rng))
    assert not any(walked[:LOOK]) and {1, 2, 3, 4} <= set(walked[LOOK:])


class Thinker(Planner):
    """Stays so often, then goes north; thinks in between."""

    thinks = True

    def __init__(self, stays):
        self.stays = stays

    def initial_memory(self, batch):
        return np.zeros(batch, np.int64), np.zeros(batch, np.int64)

    def think(self, abstract_state, memory):
        return memory[0], memory[1] + 1

    def decide(self, abstract_state, memory):
        said = np.where(memory[0] < self.stays, Instruction.STAY, Instruction.NORTH)
        return said.astype(np.int64), (memory[0] + 1, memory[1])


def decisions(planner, count):
    state, memory, said = np.zeros((1, 10, 10, 4), np.float32), planner.initial_memory(1), []
    for _ in range(count):
        memory = planner.think(state, memory)
        decision, memory = planner.decide(state, memory)
        said.append(int(decision[0]))
    return said, memory


def test_another_look_is_not_taken_for_the_end_of_wits_and_a_planner_that_stays_for_good_walks_on():
    rng = np.random.default_rng(0)
    said, _ = decisions(DisturbedPlanner(Thinker(2), NONE, rng), 30)
    assert said == [0, 0, *[int(Instruction.NORTH)] * 28]
    said, _ = decisions(DisturbedPlanner(Thinker(1000), NONE, rng), 30)
    assert not any(said[:3]) and len(set(said[3:28])) > 2


def test_a_disturbed_planner_goes_on_thinking():
    planner = DisturbedPlanner(Thinker(0), NONE, np.random.default_rng(0))
    assert planner.thinks and decisions(planner, 5)[1][1][0] == 5


class Still(Controller):
    """Gives no torque."""

    def __init__(self, body):
        self.size = body.action_size

    def initial_memory(self, batch):
        return ()

    def step(self, inputs, state):
        return np.zeros((len(inputs.instruction), self.size), np.float32), state


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
def test_torques_of_any_body_are_disturbed_and_those_turn_that_can(body):
    steady = Disturbance(shaky=1.0, max_noise=0.0, spin=1.0, spin_again=0.0)
    noisy = Disturbance(shaky=1.0, max_noise=0.4, spin=0.0, spin_again=0.0)
    instruction, proprio = np.ones(64, np.int64), np.zeros((64, body.proprio_size), np.float32)
    inputs = ControllerInput(instruction, np.zeros((64, 64, 64, 3), np.uint8), proprio, np.zeros(64, np.bool_))
    turned, shaken = (
        controller.step(inputs, controller.initial_memory(64))[0]
        for controller in (DisturbedController(Still(body), d, np.random.default_rng(0), body) for d in (steady, noisy))
    )
    assert turned.shape == shaken.shape == (64, body.action_size) and shaken.any(axis=0).all()
    if body.turn is None:
        assert not turned.any()
    else:
        assert (np.sign(turned) == np.outer(np.sign(turned).sum(axis=1), np.sign(body.turn))).all() and turned.any()
