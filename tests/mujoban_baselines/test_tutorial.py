"""The agents of docs/baselines.md work as printed, and its commands exist."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from paper_pages import write

from benchmarks.paper import __main__ as results
from benchmarks.paper import baselines, figures, runs, table1, tables
from bringup.evaluate import evaluate
from mujoban_baselines.mpo import MPOTrainingConfig
from mujoban_baselines.task import TaskConfig
from mujoban_baselines.train import COMMANDS, PROG, MPORunConfig, main, mpo_parts
from mujoban_core.agent import AgentPolicy
from mujoban_core.files import digest
from mujoban_core.plugins import load_module
from mujoban_core.program import read_options
from mujoban_rl.actors import ActorOptions
from mujoban_sokoban.episodes import Episodes

GUIDE = (Path(__file__).parents[2] / "docs" / "baselines.md").read_text()


@pytest.fixture
def modules(tmp_path, monkeypatch):
    codes = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
    names = ("my_agent", "my_map_agent")
    for name, code in zip(names, codes, strict=True):
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
    (command,) = re.findall(r"python my_map_agent.py (.*)", GUIDE)
    options = [*command.replace("--steps 500000", "--steps 700").split(), "--robots", "4"]
    assert main(options, kinds=import_module("my_map_agent").TrainMapAgent) == 0
    assert '"updates": 3' in Path("runs/baselines/map_agent/metrics.jsonl").read_text()
    agent = load_module("agent", "my_map_agent:trained")
    assert agent.ticks == 4 and agent.inner.inner.draws == "pink", "it plays as it was trained to"
    (result,) = evaluate(AgentPolicy(agent), Episodes(1, 0, difficulty=1), time_limit=20)
    assert result.steps == 20 and agent.privileged


def test_either_learner_takes_the_agent_of_the_tutorial(modules, tmp_path):
    from importlib import import_module

    kind = import_module("my_map_agent").MapAgent
    config = MPORunConfig(task=TaskConfig(robots=2), repeat=4, mpo=MPOTrainingConfig(window=8, warm_up=1))
    learner, source = mpo_parts(config, ActorOptions(), kind=kind)
    source.close()
    assert isinstance(learner.agent, kind) and learner.agent.repeat == 4
    with pytest.raises(ValueError, match="--size L: MapAgent has no sizes"):
        mpo_parts(replace(config, size="L"), ActorOptions(), kind=kind)


def test_the_row_of_the_tutorial_is_trained_by_its_program_and_played_by_its_agent(tmp_path):
    (text,) = re.findall(r'    Baseline\(\n        "map_agent".*?\n    \)', GUIDE, re.DOTALL)
    row = eval(text.strip(), vars(baselines))
    train, note, levels = table1.stages(row)
    assert train.command[:4] == ("-m", "my_map_agent", "--levels", "easy")
    assert train.command[-2:] == ("--run", "runs/baselines/map_agent") and "--cpu-seconds" in train.command
    assert train.products == (Path("runs/baselines/map_agent/agent.safetensors"),)
    assert note.products == (row.curve,) and levels.needs == (train.name, note.name)
    assert row.run(5).further == ("--agent", "my_map_agent:trained")


def test_the_row_of_the_tutorial_and_its_curve_are_on_the_page(folder, tmp_path, monkeypatch):
    (text,) = re.findall(r'    Baseline\(\n        "map_agent".*?\n    \)', GUIDE, re.DOTALL)
    row = eval(text.strip(), vars(baselines))
    rows = (*baselines.BASELINES, row)
    for module in (baselines, tables, figures, results):
        monkeypatch.setattr(module, "BASELINES", rows)
    drawn = []
    monkeypatch.setattr(figures.Figure, "legend", lambda _, handles, labels, **__: drawn.extend(labels))
    monkeypatch.setattr(baselines, "ROOT", tmp_path)
    run = tmp_path / "runs" / "baselines" / "map_agent"
    run.mkdir(parents=True)
    counts = {"solved/1_n": 30, "return/1_n": 30}
    line = {"step": 2_000_000, "cpu_seconds": 3600, "seconds": 1800, "solved/1": 0.5, "return/1": 5.5, **counts}
    (run / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    weights = run / "agent.safetensors"
    assert row.run(1).missing_weights() == weights
    weights.write_bytes(b"once")
    assert baselines.main([f"map_agent={run}"]) == 0
    write(row.run(1), 3, 4, {"agent": "my_map_agent:trained (privileged)"})
    measured = json.loads(row.run(1).file.read_text()) | {runs.TRAINED: digest(weights)}
    row.run(1).file.write_text(json.dumps(measured))
    cells = "| 2.00 M | 1.0 | 0.5 | not there | 4 | 75.0 % (30.1 to 95.4)"
    page = page_of(folder)
    assert f"| V-trace on the map (privileged) | `map_agent` | o_pr, o_pos, s_abst | easy {cells} |" in page
    assert f"    {row.commands[0]}\n" in page and baselines.JOINT.name == "joint"
    assert drawn[-1] == "V-trace on the map (privileged) (easy)" and (folder / "baselines.png").exists()
    assert runs.is_current(row.run(1), 4)
    weights.write_bytes(b"again")
    assert f"{cells}{tables.STALE} |" in page_of(folder) and not runs.is_current(row.run(1), 4)


def page_of(folder):
    return results.rebuild(folder).read_text()


def test_every_command_of_the_guide_is_one():
    printed = [text.split() for text in re.findall(rf"`((?:{'|'.join(COMMANDS)}) [^`]*--run [^`]*)`", GUIDE)]
    read = [read_options(COMMANDS, words, PROG) for words in printed]
    assert [type(command) for command in read] == [COMMANDS[name] for name, *_ in printed]
    assert {name for name, *_ in printed} == COMMANDS.keys() and len(printed) > len(COMMANDS)
