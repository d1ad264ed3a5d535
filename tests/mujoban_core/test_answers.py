"""A module of somebody's own that answers by other numbers than its role has is refused, and does not play on."""

import numpy as np
import pytest

from bringup.evaluate import evaluate
from mujoban_core.agent import Agent, AgentPolicy
from mujoban_core.answers import ModuleError
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

ORACLES = {
    "estimator": OracleEstimator, "termination": OracleTermination, "planner": OraclePlanner,
    "controller": OracleController,
}  # fmt: skip
METHODS = {"estimator": "step", "termination": "probability", "planner": "decide", "controller": "step"}


def answering(role, change):
    """Return the oracles, of which one's answers are changed."""

    def answer(self, *arguments):
        said, memory = getattr(ORACLES[role], METHODS[role])(self, *arguments)
        return change(said), memory

    changed = type("Changed", (ORACLES[role],), {METHODS[role]: answer})
    return SensePlanAct(**{name: (changed if name == role else oracle)() for name, oracle in ORACLES.items()})


def play(policy):
    evaluate(policy, Episodes(2, VALIDATION_SEEDS.start, difficulty=1), time_limit=2)


@pytest.mark.parametrize(
    ("role", "change", "said"),
    [
        ("estimator", lambda p: p * np.nan, "from nan to nan: expected probabilities, from 0 to 1"),
        ("estimator", lambda p: p * 7, r"from 0.0 to 7.0: expected probabilities"),
        ("estimator", lambda p: p[:, 1:-1, 1:-1], r"\(2, 8, 8, 4\): expected \(2, 10, 10, 4\)"),
        ("termination", lambda p: p + np.nan, "termination gives numbers from"),
        ("termination", lambda p: np.stack([p, p]), r"termination.*\(2, 2\): expected \(2,\)"),
        ("planner", lambda a: a + 0.7, "planner decides float64 numbers: expected values of grid.Instruction"),
        ("planner", lambda a: a * 0 + 9, "planner decides 9 to 9: expected values of grid.Instruction, from 0 to 4"),
        ("planner", lambda a: a * 0 - 1, "planner decides -1 to -1: expected values of grid.Instruction"),
        ("planner", lambda a: a[0], r"planner.*\(\): expected \(2,\)"),
        ("estimator", lambda _: None, r"estimator.*\(\): expected \(2, 10, 10, 4\)"),
        ("termination", lambda p: p[0], r"termination.*\(\): expected \(2,\)"),
        ("controller", lambda a: a[0], r"torques of shape \(2,\): expected \(2, 2\)"),
    ],
)
def test_an_answer_that_is_none_is_refused_and_named(role, change, said):
    with pytest.raises(ValueError, match=said):
        play(answering(role, change))


@pytest.mark.parametrize(("role", "method"), METHODS.items())
def test_a_method_that_forgets_the_memory_is_named(role, method):
    changed = type("Changed", (ORACLES[role],), {method: lambda self, *_: np.zeros(2)})
    modules = {name: (changed if name == role else oracle)() for name, oracle in ORACLES.items()}
    with pytest.raises(ValueError, match=f"{method} of the {role} returns ndarray: expected two, the answer and the n"):
        play(SensePlanAct(**modules))


@pytest.mark.parametrize("role", ORACLES)
def test_an_error_within_a_module_names_its_role_and_is_no_bad_input(role):
    with pytest.raises(ModuleError, match=f"the {role} has failed: operands could not be broadcast"):
        play(answering(role, lambda _: np.zeros(3) + np.zeros(2)))


def test_torques_of_one_robot_are_not_taken_for_all():
    class One(Agent):
        def initial_memory(self, batch):
            return ()

        def step(self, inputs, state):
            return np.zeros(2, np.float32), state

    with pytest.raises(ValueError, match=r"torques of shape \(2,\): expected \(2, 2\)"):
        play(AgentPolicy(One()))


@pytest.mark.parametrize("role", ORACLES)
def test_an_answer_as_it_is_to_be_plays(role):
    play(answering(role, lambda said: said))
