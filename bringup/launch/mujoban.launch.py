"""`ros2 launch mujoban mujoban.launch.py [module:=oracle] [body:=ant] [viz:=false]`: the graph, a process a node.

For those who have ROS 2, also without a workspace: `ros2 launch bringup/launch/mujoban.launch.py`. Without ROS 2
`python bringup/run_stack.py --processes` does the same, and restarts nodes.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from launch import LaunchDescription  # pyright: ignore
from launch.actions import DeclareLaunchArgument, ExecuteProcess  # pyright: ignore
from launch.conditions import IfCondition  # pyright: ignore
from launch.substitutions import LaunchConfiguration, PythonExpression  # pyright: ignore

ROOT = Path(__file__).resolve().parents[2]
OWN = ROOT / ".venv" / "bin" / "python"
"""The environment that `make setup` makes."""
MIXING = ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
"""Variables of a ROS 2 that has been sourced; the environment that has mujoban has an rclpy of its own."""
MODULES = {
    "estimator": "mujoban_estimator.node",
    "termination": "mujoban_estimator.termination_node",
    "planner": "mujoban_planner.node",
    "controller": "mujoban_controller.node",
}


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of the graph, with the parameters of bringup/config/stack.yaml."""
    arguments = {
        "python": (str(OWN if OWN.exists() else sys.executable), "interpreter of the environment that has mujoban"),
        "params_file": (str(ROOT / "bringup/config/stack.yaml"), "parameters of the nodes"),
        "module": ("learned", "what plays the four modules: learned, or the ball's oracle"),
        # As in run_stack.py: who is told the truth has no need to look around.
        "look_around": (
            PythonExpression(["0 if '", LaunchConfiguration("module"), "' == 'oracle' else -1"]),
            "ticks of a turn on the spot, 0 for none, -1 for the body's own",
        ),
        "body": ("ball", "the robot's body"),
        "world": ("reference", "the physical world"),
        "weights": ("", "folder of weights files, ROLE.safetensors, for the learned modules; empty: those that ship"),
        "look_ahead": ("-1", "evaluations of a search ahead by the planner, 0 for none, -1 for the planner's own"),
        "difficulty": ("5", "of the levels"),
        "realtime": ("1.0", "simulated seconds per second; 0.0 is lockstep"),
        "viz": ("true", "whether RViz and Foxglove get topics of their own"),
    }
    value = {name: LaunchConfiguration(name) for name in arguments}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in arguments.items()
    ]

    def node(module: str, *parameters: object, **options: object) -> ExecuteProcess:
        command = [value["python"], "-m", module, "--ros-args", "--params-file", value["params_file"], *parameters]
        kept = {name: text for name, text in os.environ.items() if name not in MIXING}
        return ExecuteProcess(cmd=command, cwd=str(ROOT), env=kept, output="screen", **options)

    def given(name: str, *text: object) -> tuple[object, ...]:
        return ("-p", [f"{name}:=", *text])

    def of_speed(formula: str) -> PythonExpression:
        return PythonExpression(["(lambda speed: ", formula, ")(float('", value["realtime"], "'))"])

    looking = given("look_around", value["look_around"])
    # As in run_stack.py: in real time the clock would wait for what a restarted planner can no longer say, and a search
    # ahead has a fifth of a tick.
    own = {
        "termination": given("patience", of_speed("1 if speed else 60")),
        "planner": (
            *looking,
            *given("look_ahead", value["look_ahead"]),
            *given("look_ahead_deadline", of_speed("0.2 * 0.05 / speed if speed else 0.0")),
        ),
        "controller": looking,
    }

    def weights(role: str) -> PythonExpression:
        return PythonExpression(["'", value["weights"], "' and '", value["weights"], f"/{role}.safetensors'"])

    playing = (*given("body", value["body"]), *given("world", value["world"]))
    return LaunchDescription(
        [
            *declared,
            node(
                "mujoban_sim.node",
                *given("difficulty", value["difficulty"]),
                *given("realtime", value["realtime"]),
                *playing,
            ),
            *(
                node(
                    module,
                    *given("module", value["module"]),
                    *given("weights", "'", weights(role), "'"),
                    *given("body", value["body"]),
                    *own.get(role, ()),
                )
                for role, module in MODULES.items()
            ),
            node("bringup.viz", *playing, condition=IfCondition(value["viz"])),
        ]
    )  # fmt: skip
