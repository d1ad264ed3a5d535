"""What nodes of the graph make of their parameters: weights that change, of another body, settings out of range."""

import re
import subprocess
import sys

import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter

from bringup.command import Choice, Stack
from bringup.graph_recorder import RecorderNode
from bringup.parameters import graph_parameters, read_parameters, write_parameters
from mujoban_controller import teacher_weights
from mujoban_controller.node import ControllerNode
from mujoban_core.plugins import ROLES
from mujoban_estimator.estimator import StateEstimator
from mujoban_estimator.node import EstimatorNode
from mujoban_estimator.termination_node import TerminationNode
from mujoban_planner.deliberation import Deliberation
from mujoban_planner.node import PlannerNode
from mujoban_rl.weights import save_weights
from mujoban_sim.node import SimulatorNode
from mujoban_sim.node_parameters import PARAMETERS
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import PLAY_SEEDS


def test_weights_are_loaded_while_the_graph_runs_and_bad_ones_are_refused(play_graph, oracles, fresh_weights, tmp_path):
    stack = Stack(oracles.choices | {"estimator": fresh_weights.choices["estimator"]})
    graph = play_graph(stack, time_limit=2000)
    estimator = graph.graph.nodes["estimator"]
    graph.spin_until(lambda: graph.simulator.ticks >= 3)
    module = estimator.module

    def set_weights(path):
        request = SetParameters.Request(parameters=[Parameter("weights", value=str(path)).to_parameter_msg()])
        return graph.call(SetParameters, "/estimator/set_parameters", request).results[0]

    refused = set_weights(tmp_path / "missing.safetensors")
    assert not refused.successful and "missing.safetensors" in refused.reason and estimator.module is module
    assert set_weights(fresh_weights.choices["estimator"].weights).successful
    assert estimator.module is not module
    ticks = graph.simulator.ticks
    graph.spin_until(lambda: graph.simulator.ticks > ticks + 3)


def test_a_node_that_is_killed_after_other_weights_were_loaded_starts_anew(
    play_graph, oracles, fresh_weights, tmp_path
):
    other = StateEstimator(channels=8, blocks=1)
    save_weights(tmp_path / "other.safetensors", other, other.hyperparameters(), {})
    stack = Stack(oracles.choices | {"estimator": fresh_weights.choices["estimator"]})
    graph = play_graph(stack, time_limit=2000, memories=tmp_path)
    graph.spin_until(lambda: graph.simulator.ticks >= 3)
    weights = Parameter("weights", value=str(tmp_path / "other.safetensors")).to_parameter_msg()
    request = SetParameters.Request(parameters=[weights])
    assert graph.call(SetParameters, "/estimator/set_parameters", request).results[0].successful
    ticks = graph.simulator.ticks
    graph.spin_until(lambda: graph.simulator.ticks > ticks + 3)
    graph.graph.stop("estimator")
    graph.graph.start("estimator")
    ticks = graph.simulator.ticks
    graph.spin_until(lambda: graph.simulator.ticks > ticks + 3)


def test_weights_that_need_the_ground_truth_are_refused_while_the_graph_runs(play_graph, oracles, fresh_weights):
    stack = Stack(oracles.choices | {"controller": fresh_weights.choices["controller"]})
    graph = play_graph(stack, time_limit=2000)
    module = graph.graph.nodes["controller"].module
    graph.spin_until(lambda: graph.simulator.ticks >= 3)
    teacher = Parameter("weights", value=str(teacher_weights("ball"))).to_parameter_msg()
    request = SetParameters.Request(parameters=[teacher])
    refused = graph.call(SetParameters, "/controller/set_parameters", request).results[0]
    assert not refused.successful and "ground truth" in refused.reason
    assert graph.graph.nodes["controller"].module is module
    ticks = graph.simulator.ticks
    graph.spin_until(lambda: graph.simulator.ticks > ticks + 3)


def test_weights_of_another_body_are_refused_by_a_node_when_it_starts_and_while_it_runs(
    play_graph, oracles, ant_teacher, tmp_path
):
    played = Stack(oracles.choices | {"controller": Choice("controller", weights=ant_teacher)}, body="ant")
    graph = play_graph(played, names=["controller"])
    ball = Parameter("weights", value=str(teacher_weights("ball"))).to_parameter_msg()
    request = SetParameters.Request(parameters=[ball])
    refused = graph.call(SetParameters, "/controller/set_parameters", request).results[0]
    why = "the controller was trained for the body ball: expected weights for ant, or an oracle"
    assert not refused.successful and refused.reason == why
    unfit = Stack(oracles.choices | {"controller": Choice("controller", weights=teacher_weights("ball"))}, body="ant")
    write_parameters(graph_parameters(unfit, Episodes(1, 0)), tmp_path / "ant.yaml")
    command = [sys.executable, "-m", "mujoban_controller.node", "--ros-args", "--params-file", tmp_path / "ant.yaml"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (2, f"error: {why}\n")


def test_a_node_that_is_told_a_body_alone_takes_the_weights_that_ship_for_it(ros):
    node = ControllerNode(parameter_overrides=[Parameter("body", value="ant")])
    try:
        assert node.module.config["body"] == "ant"
    finally:
        node.destroy_node()


@pytest.mark.parametrize(("speed", "seconds"), [(0.0, 0.0), (1.0, 0.01), (4.0, 0.0025)])
def test_a_search_ahead_gets_a_fifth_of_a_tick_of_real_time_and_a_number_of_evaluations_where_time_waits(
    play_graph, speed, seconds
):
    thinking = Stack(deliberation=Deliberation(look_ahead=50), look_around=0)
    planner = play_graph(thinking, names=["planner"], realtime=speed).graph.nodes["planner"].module
    assert planner.deadline == pytest.approx(seconds)


OTHER_THAN_A_NODE_ALONE = {(role, "body") for role in ROLES}
"""Parameters of a graph whose nodes, started alone, do otherwise: with weights of whichever body."""


@pytest.mark.parametrize(
    "kind", [SimulatorNode, EstimatorNode, TerminationNode, PlannerNode, ControllerNode], ids=lambda kind: kind.__name__
)
@pytest.mark.usefixtures("ros")
def test_the_parameter_file_names_what_nodes_do_by_default(kind):
    node = kind()
    try:
        name = node.get_name()
        named = read_parameters()[name]
        default = {parameter: node.get_parameter(parameter).value for parameter in named}
    finally:
        node.destroy_node()
    differing = {(name, parameter) for parameter, value in named.items() if value != default[parameter]}
    assert differing == {which for which in OTHER_THAN_A_NODE_ALONE if which[0] == name}
    assert all(type(value) is type(default[parameter]) for parameter, value in named.items())


@pytest.mark.parametrize(
    ("node", "name", "value", "reason"),
    [
        ("estimator", "device", "cuda:7", "device 'cuda:7': torch can use .* expected cpu"),
        ("estimator", "device", "meta", "device 'meta': expected cpu or cuda"),
        ("termination", "threshold", float("nan"), "threshold is nan|range"),
        ("termination", "threshold", 1.5, "range"),
        ("termination", "limit", -3, "limit is -3: expected a number of ticks|range"),
    ],
)
def test_a_setting_out_of_its_range_is_refused_with_the_reason(
    play_graph, oracles, fresh_weights, node, name, value, reason
):
    graph = play_graph(Stack(oracles.choices | {"estimator": fresh_weights.choices["estimator"]}), names=[node])
    before = graph.graph.nodes[node].get_parameter(name).value
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    result = graph.call(SetParameters, f"/{node}/set_parameters", request).results[0]
    assert not result.successful and re.search(reason, result.reason), result.reason
    assert graph.graph.nodes[node].get_parameter(name).value == before


@pytest.mark.parametrize(
    ("name", "value"), [("difficulty", 6), ("realtime", -1.0), ("resend_after", 0.0), ("episodes", -1)]
)
@pytest.mark.usefixtures("ros")
def test_a_simulator_is_not_made_with_a_parameter_out_of_its_range(name, value):
    with pytest.raises(InvalidParameterValueException, match=rf"(?s)\b{name}\b.*range"):
        SimulatorNode(parameter_overrides=[Parameter(name, value=value)])


@pytest.mark.usefixtures("ros")
def test_a_simulator_that_is_given_no_seed_plays_none_of_the_levels_for_tests():
    for defaults in ({}, read_parameters()["simulator"]):
        simulator = SimulatorNode(parameter_overrides=[Parameter(name, value=v) for name, v in defaults.items()])
        try:
            assert simulator.episodes.seed in PLAY_SEEDS
        finally:
            simulator.destroy_node()


def test_every_parameter_of_the_simulator_and_the_recorder_says_what_it_means(play_graph, tmp_path):
    simulator = play_graph().simulator
    path = Parameter("path", value=str(tmp_path / "bag"))
    recorder = RecorderNode(context=simulator.context, parameter_overrides=[path])
    try:
        for node, own in ((simulator, PARAMETERS), (recorder, ("path", "episodes_per_file", "body", "world"))):
            assert all(about.description for about in node.describe_parameters(list(own)))
    finally:
        recorder.destroy_node()


def test_missing_weights_stop_a_node_with_a_clear_error(play_graph, oracles, tmp_path):
    choices = oracles.choices | {"planner": Choice("planner", weights=tmp_path / "none.safetensors")}
    with pytest.raises(ValueError, match="none"):
        play_graph(Stack(choices))
