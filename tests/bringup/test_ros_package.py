"""The package `mujoban` of a colcon workspace: its programs are the nodes of the guide."""

import os
import re
import subprocess
from pathlib import Path

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
