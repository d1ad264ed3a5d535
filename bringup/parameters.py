"""The parameters that the nodes of a graph are started with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from bringup.command import Choice, Player, Solo
from mujoban_core.grid import CONTROL_PERIOD
from mujoban_core.look_around import LOOKING_ROLES
from mujoban_core.plugins import AGENT, ROLES
from mujoban_planner.deliberation import REALTIME_SHARE
from mujoban_sokoban.episodes import Episodes

DEFAULTS = Path(__file__).parent / "config" / "stack.yaml"

Parameters = dict[str, dict[str, Any]]
"""Node -> parameter -> value."""


def read_parameters(path: Path = DEFAULTS) -> Parameters:
    """Return the parameters of a ROS 2 parameter file.

    Raises:
        ValueError: If it is none.
        OSError: If it cannot be read.
    """
    try:
        content = yaml.safe_load(path.read_text())
        return {node.lstrip("/"): dict(entry["ros__parameters"]) for node, entry in content.items()}
    except (yaml.YAMLError, AttributeError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: not a ROS 2 parameter file (node: ros__parameters: ...): {error}") from error


def write_parameters(parameters: Parameters, path: Path) -> None:
    """Write a ROS 2 parameter file."""
    path.write_text(yaml.safe_dump({node: {"ros__parameters": values} for node, values in parameters.items()}))


def graph_parameters(stack: Player, episodes: Episodes, *, run: int = 0, **simulator: Any) -> Parameters:
    """Return the parameters of a graph that plays some episodes with some modules, or with an agent alone.

    Args:
        stack: The modules, or the agent.
        episodes: The episodes.
        run: Its identifier, see `mujoban_msgs_py.run_identifier`.
        **simulator: Further parameters of the simulator.
    """
    parameters = read_parameters()
    parameters["simulator"] |= {
        "run": run,
        "body": stack.body,
        "seed": episodes.seed,
        "episodes": len(episodes),
        "level_file": "" if episodes.level_file is None else str(episodes.level_file),
        **simulator,
    }
    if episodes.level_file is None:
        parameters["simulator"]["difficulty"] = episodes.difficulty
    if isinstance(stack, Solo):
        parameters["simulator"]["instructed"] = False
        return {"simulator": parameters["simulator"], AGENT: {"run": run, **_loaded(stack.choice, stack)}}
    for role in ROLES:
        parameters[role] |= {"run": run, **_loaded(stack.choices[role], stack)}
    deadline = 0.0
    if speed := simulator.get("realtime"):
        parameters["termination"]["patience"] = 1
        deadline = REALTIME_SHARE * CONTROL_PERIOD / speed
    for role in LOOKING_ROLES:
        parameters[role]["look_around"] = stack.look_around_ticks
    parameters["planner"] |= {
        "thinking": stack.deliberation.thinking,
        "look_ahead": stack.deliberation.evaluations(stack.choices["planner"].source),
        "look_ahead_per_tick": stack.deliberation.per_tick,
        "look_ahead_certainty": stack.deliberation.certainty,
        "look_ahead_deadline": deadline,
        "scout": stack.scout.source,
        "scout_weights": "" if stack.scout.weights is None else str(stack.scout.weights),
    }
    return parameters


def _loaded(choice: Choice, player: Player) -> dict[str, Any]:
    """Return the parameters that say what a node loads, and how."""
    return {
        "module": choice.source,
        "weights": "" if choice.weights is None else str(choice.weights),
        "body": player.body,
        "device": player.device,
        "told": -1 if choice.told is None else int(choice.told),
        "threads": player.threads,
    }
