"""The package `mujoban` of a colcon workspace: its programs are the nodes of the guide."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from bringup.command import Stack
from bringup.parameters import graph_parameters
from mujoban_core.bodies import BALL
from mujoban_msgs_py.runtime.module_node import OWN_LOOK
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.episodes import Episodes

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "bringup" / "ros_package"


def programs():
    """Return the module of each program that the package installs."""
    text = (PACKAGE / "CMakeLists.txt").read_text()
    names, modules = (re.findall(rf"set\({kind} ([^)]*)\)", text)[0].split() for kind in ("nodes", "modules"))
    return dict(zip(names, modules, strict=True))


def test_every_node_of_the_guide_is_a_program_of_ros2_run():
    rows = re.findall(r"^\| (\w+) \| `python -m ([\w.]+)`", (ROOT / "docs" / "graph.md").read_text(), re.MULTILINE)
    assert programs() == dict(rows) and len(rows) == 8


def test_a_program_starts_in_its_environment_and_takes_nothing_of_the_ros_that_was_sourced(tmp_path):
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$PYTHONPATH|$LD_LIBRARY_PATH|$AMENT_PREFIX_PATH|$ROS_DOMAIN_ID|$*"\n')
    python.chmod(0o755)
    text = (PACKAGE / "node.sh.in").read_text()
    for name, value in (("node", "planner"), ("module", "mujoban_planner.node"), ("MUJOBAN_PYTHON", str(python))):
        text = text.replace(f"@{name}@", value)
    program = tmp_path / "planner"
    program.write_text(text)
    program.chmod(0o755)
    sourced = {"PYTHONPATH": "/ros", "LD_LIBRARY_PATH": "/ros", "AMENT_PREFIX_PATH": "/ros", "ROS_DOMAIN_ID": "7"}
    command = [program, "--ros-args", "-p", "module:=oracle"]
    said = subprocess.run(command, env={**os.environ, **sourced}, check=True, capture_output=True, text=True).stdout
    assert said == "|||7|-m mujoban_planner.node --ros-args -p module:=oracle\n"


@pytest.fixture
def launched(monkeypatch):
    """Return a function that gives the commands of the launch file's nodes, without the package `launch`."""
    given: dict[str, str] = {}

    def text(part):
        return part if isinstance(part, str) else "".join(map(text, part)) if isinstance(part, list) else part()

    def argument(name, default_value, description):
        given.setdefault(name, text(default_value))

    def process(cmd, **options):
        return [text(word) for word in cmd]

    for name, values in {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": argument, "ExecuteProcess": process},
        "launch.conditions": {"IfCondition": lambda value: None},
        "launch.substitutions": {
            "LaunchConfiguration": lambda name: lambda: given[name],
            "PythonExpression": lambda parts: lambda: str(eval(text(parts))),
        },
    }.items():
        module = ModuleType(name)
        module.__dict__.update(values)
        monkeypatch.setitem(sys.modules, name, module)

    def commands(**arguments):
        given.clear()
        given.update(arguments)
        described = runpy.run_path(str(ROOT / "bringup/launch/mujoban.launch.py"))["generate_launch_description"]()
        return {command[2]: command for command in described if command}

    return commands


@pytest.mark.parametrize(
    ("arguments", "ticks"),
    [({}, OWN_LOOK), ({"module": "oracle"}, 0), ({"module": "oracle", "look_around": "8"}, 8)],
)
def test_launched_oracles_do_not_look_around(launched, arguments, ticks):
    nodes = launched(**arguments)
    assert len(nodes) == 6
    for name in ("mujoban_planner.node", "mujoban_controller.node"):
        assert f"look_around:={ticks}" in nodes[name]
    assert "look_around" not in " ".join(nodes["mujoban_estimator.node"])
    assert "patience:=1" in nodes["mujoban_estimator.termination_node"]


def test_the_launch_file_and_run_stack_have_the_same_defaults(launched):
    nodes = launched()
    simulator, planner = nodes["mujoban_sim.node"], nodes["mujoban_planner.node"]
    assert f"world:={DEFAULT_WORLD}" in simulator and f"body:={BALL.name}" in simulator
    usual = graph_parameters(Stack(), Episodes(1, 0), realtime=1.0)["planner"]
    (deadline,) = (float(word.partition(":=")[2]) for word in planner if word.startswith("look_ahead_deadline"))
    assert deadline == pytest.approx(usual["look_ahead_deadline"]) and "look_ahead:=-1" in planner


def test_another_body_world_and_weights_are_launched_for_every_node(launched):
    nodes = launched(body="ant", world="reference", weights="/trained", realtime="0.0", look_ahead="400")
    assert all("body:=ant" in command for command in nodes.values())
    assert all("world:=reference" in nodes[name] for name in ("mujoban_sim.node", "bringup.viz"))
    assert "weights:='/trained/controller.safetensors'" in nodes["mujoban_controller.node"]
    assert {"look_ahead:=400", "look_ahead_deadline:=0.0"} <= set(nodes["mujoban_planner.node"])
    assert "weights:=''" in launched()["mujoban_planner.node"]
