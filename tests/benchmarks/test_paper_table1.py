"""All rows of Table 1 by one command: what it runs, in which order."""

import shlex

import pytest

from benchmarks.paper import runs, table1
from benchmarks.paper.baselines import BASELINES, MODULAR
from bringup.pipeline import Pipeline


@pytest.fixture
def ran(monkeypatch):
    """Run nothing in the repository's root; return the names of the stages that would run."""
    names: list[str] = []
    monkeypatch.chdir(runs.ROOT)
    monkeypatch.setattr(table1, "run_shown", lambda pipeline: names.extend(stage.name for stage in pipeline.stages))
    return names


@pytest.mark.parametrize("name", [baseline.name for baseline in BASELINES])
def test_a_row_is_trained_by_the_commands_of_the_page_then_plays_every_difficulty(tmp_path, name):
    baseline = table1.KNOWN[name]
    stages = table1.stages(baseline)
    Pipeline(tmp_path, stages)  # refuses needs that are not met
    trained = [shlex.join(("python", *stage.command)) for stage in stages if "--run" in stage.command]
    assert trained == list(baseline.commands)
    levels = stages[-1]
    assert set(levels.needs) == {stage.name for stage in stages[:-1]}
    assert levels.command[-5:] == tuple(f"{name}_{difficulty}" for difficulty in range(1, 6))
    played = set(baseline.run(5).own.values())
    assert played <= {product for stage in stages[:-1] for product in stage.products}


def test_the_modular_row_comes_first_and_what_is_cloned_before_all(ran):
    assert table1.main([]) == 0
    assert ran[:2] == ["stack", MODULAR.name]
    assert ran.index("mpo_cloned_start") < ran.index("mpo_cloned") < ran.index("mpo_cloned_levels")
    assert {f"{baseline.name}_levels" for baseline in BASELINES} <= set(ran)


def test_only_what_is_named_runs(ran):
    assert table1.main(["--only", "random", "vtrace_seed1"]) == 0
    assert ran == ["random_levels", "vtrace_seed1", "vtrace_seed1_curve", "vtrace_seed1_levels"]


def test_unknown_rows_and_other_folders_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="--only nobody: expected some of modular, random"):
        table1.main(["--only", "nobody"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="expected to run in the repository's root"):
        table1.main(["--only", "random"])
