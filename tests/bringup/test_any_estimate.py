"""No estimate, however foolish, crashes what reads it: planners, looks, the scripted driver, reports and views."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bringup.failure import EpisodeLog, is_unsolvable
from bringup.overlay import grid_picture
from bringup.view import grid_text
from mujoban_core.grid import AGENT, BOX, TARGET, Instruction
from mujoban_core.interfaces import ControllerInput, GroundTruth
from mujoban_core.look_around import LookAroundPlanner
from mujoban_core.viewpoints import step_to_view, turn_view
from mujoban_planner import load
from mujoban_sim.oracles import OracleController, OraclePlanner

probabilities = st.sampled_from([0.0, 1e-38, 0.01, 0.3, 0.5, 0.9, 1.0]) | st.floats(0, 1, width=32)


def estimates(count):
    """Abstract states that are mostly one value a layer, [count, 10, 10, 4], and anything elsewhere."""
    layer = hnp.arrays(np.float32, (count, 10, 10), elements=probabilities, fill=probabilities)
    return st.tuples(layer, layer, layer, layer).map(lambda layers: np.stack(layers, -1))


def positions(limit):
    """Centres of 0 to 6 boxes."""
    shape = st.tuples(st.integers(0, 6), st.just(2))
    return hnp.arrays(np.float32, shape, elements=st.floats(-limit, limit, width=32))


any_settings = settings(
    max_examples=25, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)


@pytest.fixture(scope="module")
def planners():
    learned = load()
    return [learned, OraclePlanner(max_nodes=200), LookAroundPlanner(learned, 2), LookAroundPlanner(OraclePlanner(), 2)]


def test_a_floor_that_reaches_the_edge_of_the_grid_is_walked_no_further():
    state = np.zeros((10, 10, 4), np.float32)
    state[9, 9, AGENT] = 1.0
    state[4:6, 4:6, 0] = 0.5
    assert step_to_view(state, np.zeros((10, 10), np.bool_)) in (*Instruction, None)


@any_settings
@given(states=estimates(3))
def test_planners_decide_on_any_estimates(planners, states):
    for planner in planners:
        now = planner.initial_state(np.arange(1))
        for state in states:
            instruction, now = planner.step(state[None], np.array([True]), now)
            assert 0 <= instruction[0] < len(Instruction)


def test_nothing_is_proven_of_a_state_without_walls_around_it():
    state = np.zeros((10, 10, 4), np.bool_)
    state[5, 5, AGENT] = state[4, 4, BOX] = state[3, 3, TARGET] = True
    assert not is_unsolvable(state)


@any_settings
@given(states=estimates(2), seen=hnp.arrays(np.bool_, (10, 10)))
def test_looks_reports_and_views_take_any_estimate(states, seen):
    state, truth = states
    assert step_to_view(state, seen) in (*Instruction, None)
    assert turn_view(state).shape == (10, 10)
    log = EpisodeLog(0)
    for timed_out in (False, True):
        log.decided(truth, state, 1, timed_out)
    assert log.result(solved=False, steps=3, episode_return=0.0, last=truth).failure is not None
    assert grid_text(state) and grid_picture(state).ndim == 3


@any_settings
@given(
    states=estimates(1),
    boxes=positions(2.0**127),
    later=positions(8.0),
    instruction=st.sampled_from(list(Instruction)),
)
def test_the_scripted_driver_takes_any_truth(states, boxes, later, instruction):
    controller = OracleController()
    memory = controller.initial_memory(1)
    for begun, box_position in ((True, boxes), (False, later)):
        truth = GroundTruth(states, np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32), box_position[None],
                            np.array([False]))  # fmt: skip
        inputs = ControllerInput(
            np.array([instruction]), np.zeros((1, 64, 64, 3), np.uint8), np.zeros((1, 16), np.float32),
            np.array([begun]), truth,
        )  # fmt: skip
        torque, memory = controller.step(inputs, memory)
        assert np.isfinite(torque).all() and np.abs(torque).max() <= 1.0


def test_more_boxes_than_targets_is_no_level_and_no_crash():
    state = np.zeros((1, 10, 10, 4), np.float32)
    state[..., BOX] = 1.0
    planner = OraclePlanner()
    instruction, _ = planner.step(state, np.array([True]), planner.initial_state(np.arange(1)))
    assert instruction[0] == Instruction.STAY
