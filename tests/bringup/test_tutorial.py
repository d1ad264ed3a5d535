"""The tutorial's planner works as printed."""

import re
import sys
from pathlib import Path

import pytest

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
