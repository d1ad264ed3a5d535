"""What nodes make of the arguments of ROS: names that are changed, parameters that there are not."""

import time
from pathlib import Path

import pytest
from rclpy.context import Context
from rclpy.qos import QoSPresetProfiles
from sensor_msgs.msg import Image

from bringup.graph import InProcess
from bringup.parameters import graph_parameters
from mujoban_msgs_py import topics
from mujoban_msgs_py.runtime import tick_node
from mujoban_msgs_py.runtime.tick_node import _USAGE, ros_context, run_node
from mujoban_sim.node import SimulatorNode
from mujoban_sim.observation import GLANCE
from mujoban_sokoban.episodes import Episodes


def test_a_graph_whose_topics_are_renamed_plays_and_knows_who_only_watches(oracles):
    renamed = {topics.TORQUE: "/arm/torque", topics.INSTRUCTION: "/arm/instruction", topics.TOP_CAMERA: "/above"}
    rules = [word for topic, name in renamed.items() for word in ("-r", f"{topic.name}:={name}")]
    context = Context()
    parameters = graph_parameters(oracles, Episodes(1, 47, difficulty=2))
    with ros_context(["--ros-args", *rules], context), InProcess(parameters, context=context) as graph:
        simulator = graph.nodes["simulator"]
        simulator.create_subscription(Image, "/above", lambda _: None, QoSPresetProfiles.SENSOR_DATA.value)
        deadline = time.monotonic() + 60
        while simulator.ticks < 3 or simulator._observation._top_period != GLANCE:
            assert time.monotonic() < deadline, "the simulator waits for answers on names that are not theirs"
            graph.executor.spin_once(timeout_sec=0.05)
        assert simulator.count_publishers("/arm/torque") == 1 and not simulator.count_publishers("/torque")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["-p", "difficulty=1"], "'-p difficulty=1'"),
        (["--params-file", "nofile.yaml"], "nofile.yaml'. Error: Error opening YAML file"),
        (["--params-file", "FILE"], "FILE'. Error: Error parsing"),
        (["--bogus"], "--bogus"),
    ],
)
def test_arguments_that_ros_cannot_read_end_a_node_with_one_line(arguments, named, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("simulator: {ros__parameters: {difficulty: [1")
    assert run_node(SimulatorNode, ["--ros-args", *arguments]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("error: ") and named in line and line.endswith(f", expected {_USAGE}")
    assert "project/src" not in line


def test_a_parameter_that_a_node_has_not_is_named_with_those_that_are_near(monkeypatch, capfd):
    monkeypatch.setattr(tick_node, "spin", lambda *_: None)
    given = ["diffculty:=1", "difficulty:=2", "use_sim_time:=true", "qos_overrides./pose.publisher.depth:=9"]
    assert run_node(SimulatorNode, ["--ros-args", *(word for one in given for word in ("-p", one))]) == 0
    (line,) = (line for line in capfd.readouterr().err.splitlines() if "no parameter" in line)
    assert line.endswith("no parameter diffculty of this node, which ignores it: expected difficulty")
