"""The planners of the tutorial and the README work as printed."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.readme import Source, read_page
from bringup.rollout import rollout
from mujoban_core.plugins import load_module
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_sim.oracles import OracleController, OracleEstimator, OracleTermination
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

TUTORIAL = Path(__file__).parents[2] / "docs" / "swap_a_planner.md"


@pytest.fixture
def planner(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TUTORIAL.read_text(), re.DOTALL)
    (tmp_path / "my_planner.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield load_module("planner", "my_planner:BreadthFirstPlanner")
    sys.modules.pop("my_planner", None)


def test_the_planner_of_the_tutorial_solves_levels_with_one_box(planner):
    episodes = Episodes(6, 1000, difficulty=1)
    world = World(6, max_boxes=episodes.max_boxes)
    policy = SensePlanAct(OracleEstimator(), OracleTermination(), planner, OracleController())
    assert all(result.solved for result in rollout(policy, world, episodes))


def test_the_planner_of_the_readme_plays_the_same_again(tmp_path, monkeypatch):
    parts = read_page((TUTORIAL.parents[1] / "README.md").read_text())
    (source,) = (part for part in parts if isinstance(part, Source))
    (tmp_path / "readme_planner.py").write_text(source.text)
    monkeypatch.syspath_prepend(str(tmp_path))
    first, again = (decisions(load_module("planner", "readme_planner:RandomPlanner")) for _ in range(2))
    assert first == again and {move for moves in first for move in moves} == {1, 2, 3, 4}


def decisions(planner):
    """Return what a planner decides for two robots, 20 times."""
    memory, decided = planner.initial_memory(2), []
    for _ in range(20):
        moves, memory = planner.decide(np.zeros((2, 10, 10, 4), np.float32), memory)
        decided.append(moves.tolist())
    return decided
