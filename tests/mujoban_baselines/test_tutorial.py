"""The agents of docs/baselines.md work as printed, and its commands exist."""

import re
import sys
from pathlib import Path

import pytest

from bringup.evaluate import evaluate
from mujoban_baselines.train import COMMANDS
from mujoban_core.agent import AgentPolicy
from mujoban_core.plugins import load_module
from mujoban_sokoban.episodes import Episodes

GUIDE = (Path(__file__).parents[2] / "docs" / "baselines.md").read_text()


@pytest.fixture
def modules(tmp_path, monkeypatch):
    codes = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    names = ("my_agent", "my_map_agent")
    chaser, network, loading = codes
    for name, code in zip(names, (chaser, f"{network}\n\n{loading}"), strict=True):
        (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield names
    for name in names:
        sys.modules.pop(name, None)


def test_the_agent_of_the_tutorial_plays(modules):
    agent = load_module("agent", "my_agent:BoxChaser")
    assert agent.privileged
    results = evaluate(AgentPolicy(agent), Episodes(8, 0, difficulty=1), time_limit=400)
    assert sum(result.episode_return > 0 for result in results) >= 1, "it pushes some box home"


def test_the_agent_that_learns_does_so_on_the_engine_and_plays(modules, tmp_path, monkeypatch):
    from importlib import import_module

    monkeypatch.chdir(tmp_path)
    trainer = import_module("my_map_agent").trainer(Path("runs/map_agent"), steps=700)
    assert trainer.run()
    assert trainer.progress.updates >= 2
    agent = load_module("agent", "my_map_agent:trained")
    (result,) = evaluate(AgentPolicy(agent), Episodes(1, 0, difficulty=1), time_limit=20)
    assert result.steps == 20 and agent.privileged


def test_every_command_of_the_guide_is_one():
    named = set(re.findall(r"`([a-z]+(?:-[a-z]+)?) (?:--[a-z.-]+ \S+ )*--run", GUIDE))
    assert named == COMMANDS.keys()
