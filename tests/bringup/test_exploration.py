"""Disturbed recordings: what the stack does, and more."""

import numpy as np

from bringup.exploration import Disturbance, DisturbedPlanner, disturbed
from bringup.rollout import ticks
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Planner
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
