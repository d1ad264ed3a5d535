"""Every example runs as it is printed."""

import runpy
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from bringup.rollout import ticks
from bringup.rollout_recorder import Recorder
from mujoban_core.bodies import BALL
from mujoban_sim.presets import WORLDS
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Return a function that runs an example with arguments and returns what it prints."""
    monkeypatch.chdir(tmp_path)

    def example(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        with suppress(SystemExit):
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        said = capsys.readouterr()
        return said.out + said.err

    return example


def test_a_policy_is_trained_with_a_well_known_library(run):
    assert "over 2 episodes" in run("train_with_a_library.py", 8)


def test_the_environment_of_the_librarys_example_is_one_that_libraries_take():
    from gymnasium.utils.env_checker import check_env

    env = runpy.run_path(str(EXAMPLES / "train_with_a_library.py"))["make"]()
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert observation.ndim == 1 and env.observation_space.contains(observation)


def test_an_agent_is_evaluated_beside_the_stack(run):
    said = run("evaluate_beside_the_stack.py", 2)
    assert "wanderer\n  solved" in said and "stack of oracles\n  solved 2 of 2" in said


def test_a_module_is_replaced(run):
    said = run("replace_a_module.py", 2)
    assert "oracle planner\n  solved 2 of 2" in said and "random planner\n  solved" in said


@pytest.mark.parametrize("world", WORLDS)
def test_a_bag_is_replayed_in_the_world_that_it_names(run, oracles, tmp_path, world):
    spec = EpisodeSpec(generate_level(1, TRAIN_SEEDS.start), TRAIN_SEEDS.start)
    with Recorder(tmp_path / "bag", BALL, [spec], [1], world=world) as recorder:
        for tick in ticks(oracles.policy(), World(1, world=world, max_boxes=1), [spec], camera=True):
            recorder.write(tick)
    (bag,) = (tmp_path / "bag").iterdir()
    assert f"seed {spec.seed}: {tick.step[0] + 1} ticks, at most 0.0e+00 apart" in run("replay_a_bag.py", bag)


@pytest.mark.parametrize(
    ("arguments", "said"), [((), "0 arguments, expected one"), (("none",), "no bag at none, expected a folder")]
)
def test_a_bag_that_is_missing_is_one_line(run, arguments, said):
    line = run("replay_a_bag.py", *arguments)
    assert line.startswith(f"replay_a_bag.py: error: {said}") and line.count("\n") == 1


def test_no_example_is_left_out():
    tested = Path(__file__).read_text()
    assert all(f'"{path.name}"' in tested for path in EXAMPLES.glob("*.py"))
