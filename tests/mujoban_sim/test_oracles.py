import numpy as np
import pytest

from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput, Observation, TerminationInput
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import generate_levels
from mujoban_sokoban.levels import Level
from mujoban_sokoban.solver import solve_level

NO_FRAME = np.zeros((1, 1, 1, 3), np.uint8)


def play(world, episodes, limit=4800):
    """Play one episode per row with four oracles; return the instructions issued per row."""
    policy = SensePlanAct(OracleEstimator(), OracleTermination(), OraclePlanner(), OracleController())
    world.reset(np.arange(world.batch), episodes)
    state = policy.initial_state(np.array([e.seed for e in episodes]))
    issued = np.zeros(world.batch, int)
    for _ in range(limit):
        observation = Observation(NO_FRAME, world.proprio, world.pose)
        decision, state = policy.step(observation, world.truth(), state)
        issued += decision.issued & ~world.done
        world.instruct(decision.instruction, decision.issued)
        world.step(decision.torque)
        if world.done.all():
            break
    return issued


def test_four_oracles_solve_difficulty_5():
    batch = 8
    world = World(batch)
    episodes = [EpisodeSpec(level, i) for i, level in enumerate(generate_levels(5, range(batch)))]
    issued = play(world, episodes)
    assert world.solved.all()
    assert np.allclose(world.episode_return, 14.0)
    optimal = np.array([len(solve_level(e.level).moves) for e in episodes])
    assert (issued >= optimal).all() and issued.sum() <= 1.02 * optimal.sum()


def test_four_oracles_solve_a_small_level_with_fewer_boxes():
    world = World(1, max_boxes=4)
    play(world, [EpisodeSpec(Level.from_text("#####\n#@  #\n# $ #\n#. ##\n#####\n"), 3)], limit=1200)
    assert world.solved[0]


def test_oracle_planner_follows_an_optimal_plan_and_then_stays():
    level = Level.from_text("#######\n#@$ . #\n#######\n")
    planner = OraclePlanner()
    memory = planner.initial_memory(1)
    state = level.abstract_state()[None].copy()
    for _ in range(2):
        move, memory = planner.decide(state, memory)
        assert move[0] == Instruction.EAST
        state[..., 2:] = np.roll(state[..., 2:], 1, axis=2)
    move, memory = planner.decide(state, memory)
    assert move[0] == Instruction.STAY


def test_oracle_planner_plans_again_when_the_state_is_not_the_expected_one():
    level = Level.from_text("#####\n#  @#\n# $ #\n# . #\n#####\n")
    planner = OraclePlanner()
    state = level.abstract_state()[None]
    move, memory = planner.decide(state, planner.initial_memory(1))
    assert move[0] == Instruction.WEST
    # The instruction failed: the robot is where it was. The plan made before goes on to the south.
    again, memory = planner.decide(state, memory)
    assert again[0] == Instruction.WEST


def test_oracle_planner_stays_where_there_is_no_solution():
    stuck = Level.from_text("#####\n#@ $#\n#  .#\n#####\n")
    lost = Level.from_text("#####\n#$@ #\n#  .#\n#####\n")
    planner = OraclePlanner()
    for level in (stuck, lost):
        state = level.abstract_state()[None].copy()
        state[..., 1] = 0 if level is stuck else state[..., 1]
        move, _ = planner.decide(state, planner.initial_memory(1))
        assert move[0] == Instruction.STAY


def test_oracles_ask_for_the_ground_truth_that_they_need():
    frame, proprio = np.zeros((1, 64, 64, 3), np.uint8), np.zeros((1, 16), np.float32)
    no = np.zeros(1, bool)
    with pytest.raises(ValueError, match="ground truth"):
        OracleTermination().probability(TerminationInput(frame, proprio, np.zeros(1, np.int64), no), ())
    controller = OracleController()
    with pytest.raises(ValueError, match="ground truth"):
        controller.step(ControllerInput(np.zeros(1, np.int64), frame, proprio, no), controller.initial_memory(1))
    assert all(m.privileged for m in (OracleEstimator, OracleTermination, OraclePlanner, OracleController))
