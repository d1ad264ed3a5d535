import numpy as np
import pytest

from bringup.rollout import ticks
from mujoban_sim.episodes import Episodes
from mujoban_sim.look_around import LOOK_AROUND_TICKS, look_around
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sim.sense_plan_act import SensePlanAct
from mujoban_sim.world import World


def test_the_robot_turns_once_on_the_spot_then_solves_the_level_as_ever():
    parts = (OracleEstimator(), OracleTermination(), OraclePlanner(), OracleController())
    policy = SensePlanAct(*(look_around(part, LOOK_AROUND_TICKS) for part in parts))  # pyright: ignore
    headings, places, instructions = [], [], []
    solved = False
    for tick in ticks(policy, World(1), Episodes(1, 7, difficulty=1)):
        headings.append(tick.observation.pose[0, 2])
        places.append(tick.observation.pose[0, :2])
        instructions.append(int(tick.decision.instruction[0]))
        solved |= bool(tick.solved[0])
    looking = LOOK_AROUND_TICKS
    assert not any(instructions[:looking]) and any(instructions[looking : looking + 3])
    turned = np.abs(np.unwrap(headings[:looking])[-1] - headings[0])
    assert turned > 0.9 * 2 * np.pi
    assert np.abs(np.array(places[:looking]) - places[0]).max() < 0.1
    assert solved


def test_a_negative_time_is_refused():
    with pytest.raises(ValueError, match="look_around -1: expected a number of ticks"):
        look_around(OraclePlanner(), -1)
