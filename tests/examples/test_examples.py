"""Every example runs as it is printed."""

import re
import runpy
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from bringup.evaluate import main as evaluate_main
from bringup.rollout import ticks
from bringup.rollout_recorder import Recorder
from mujoban_baselines.random_agent import RandomAgent
from mujoban_baselines.repeat import Repeating
from mujoban_core.agent import OWN_SENSES, AgentInput, AgentPolicy
from mujoban_core.bodies import BALL, BODIES
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES
from mujoban_sim.presets import WORLDS
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import PLAY_SEEDS, TRAIN_SEEDS, generate_level

EXAMPLES = Path(__file__).parents[2] / "examples"
POLICY_EXAMPLE = EXAMPLES / "evaluate_beside_the_stack.py"


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


@pytest.fixture
def trained(run, tmp_path, monkeypatch):
    """Return what the training example prints; the policy is in the working directory then."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return run("train_with_a_library.py", 8)


@pytest.fixture
def agents():
    """Return what the evaluating example defines."""
    return runpy.run_path(str(POLICY_EXAMPLE))


def make():
    """Return the environment of the training example."""
    return runpy.run_path(str(EXAMPLES / "train_with_a_library.py"))["make"]()


@pytest.mark.parametrize("stack", [(), ("--oracle", ",".join(ROLES))], ids=["learned", "oracles"])
def test_a_policy_is_trained_with_a_well_known_library_and_evaluated_beside_the_stack(run, trained, stack):
    assert "over 2 episodes" in trained
    said = run("evaluate_beside_the_stack.py", "--episodes", 1, "--time-limit", 1200, *stack)
    policy, modules = said.split("\nstack\n")
    assert policy.startswith("trained policy\n  solved ") and " of 1 " in policy
    assert f"privileged, told the ground truth: agent: weights {digest('ppo_mujoban.zip')[:12]}" in policy
    assert modules.startswith("  solved 1 of 1") and ("estimator: oracle" in modules) == bool(stack)


def test_a_training_shows_its_progress_and_leaves_no_folder_of_the_librarys(trained, tmp_path):
    assert "total_timesteps" in trained and (tmp_path / "ppo_mujoban.zip").exists()
    assert not list(tmp_path.glob("SB3-*"))


def test_the_environment_of_the_librarys_example_is_one_that_libraries_take():
    from gymnasium.utils.env_checker import check_env

    env = make()
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == {"proprio", "pose", "abstract_state"} <= set(AgentInput._fields)


def test_the_agent_does_what_the_librarys_policy_does_in_the_environment_that_it_learned_in(trained, agents):
    from stable_baselines3 import PPO

    model, env, seed = PPO.load("ppo_mujoban"), make(), TRAIN_SEEDS.start
    policy, world = AgentPolicy(agents["Trained"]()), World(1, max_boxes=1)
    observation, _ = env.reset(seed=seed)
    for tick in islice(ticks(policy, world, [EpisodeSpec(generate_level(1, seed), seed)]), 20):
        torque, _ = model.predict(observation, deterministic=True)
        np.testing.assert_allclose(tick.decision.torque[0], torque, atol=1e-6)
        observation, *_ = env.step(tick.decision.torque[0])


def test_a_policy_that_was_trained_on_the_task_itself_sees_what_the_robot_sees(run, agents):
    import gymnasium
    from stable_baselines3 import PPO

    # Untrained, which is all one to who plays it.
    PPO("MultiInputPolicy", gymnasium.make("Mujoban-v0", difficulty=1), n_steps=8, device="cpu").save("ppo_mujoban")
    policy = AgentPolicy(agents["Trained"]())
    assert set(policy.sees) == set(OWN_SENSES) and policy.cameras == ("first_person",) and not policy.privileged
    said = run("evaluate_beside_the_stack.py", "--episodes", 1, "--time-limit", 5, "--oracle", ",".join(ROLES))
    assert "agent: " not in said.split("\nstack\n")[0]


def test_other_programs_play_the_policy_by_the_command_that_is_printed(trained, monkeypatch, capsys):
    (command,) = re.findall(r"PYTHONPATH=examples python bringup/evaluate\.py (.*)", POLICY_EXAMPLE.read_text())
    monkeypatch.syspath_prepend(str(EXAMPLES))
    assert evaluate_main([*command.split(), "--episodes", "1", "--time-limit", "5"]) == 0
    assert "solved 0 of 1" in capsys.readouterr().out
    sys.modules.pop(POLICY_EXAMPLE.stem)


def test_a_policy_of_another_body_is_one_line(run, trained):
    said = run("evaluate_beside_the_stack.py", "--body", "ant")
    assert said.endswith("error: the agent was trained for the body ball: expected weights for ant, or an oracle\n")
    assert said.count("\n") == 1


def test_a_policy_whose_observations_have_no_names_is_one_line(run):
    from gymnasium.wrappers import FlattenObservation
    from stable_baselines3 import PPO

    PPO("MlpPolicy", FlattenObservation(make()), n_steps=8, device="cpu").save("flat")
    said = run("evaluate_beside_the_stack.py", "flat.zip")
    assert "error: flat.zip is a policy whose observations have no names: expected one that" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", ["train_with_a_library.py", "evaluate_beside_the_stack.py"])
def test_a_library_that_is_missing_is_one_line(run, monkeypatch, name):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    said = run(name)
    assert said == f"{name}: error: stable_baselines3 is not installed: expected pip install 'mujoban[examples]'\n"


@pytest.mark.parametrize(
    ("name", "argument", "said"),
    [
        ("train_with_a_library.py", "many", "[STEPS]: many, expected a whole number from 2 on"),
        ("evaluate_beside_the_stack.py", "none.zip", "no policy at none.zip: expected one that train_with_a_library"),
        ("evaluate_beside_the_stack.py", __file__, f"{__file__} is no policy of PPO"),
        ("replace_a_module.py", "0", "[EPISODES]: 0, expected a whole number from 1 on"),
    ],
)
def test_a_bad_argument_is_one_line(run, name, argument, said):
    line = run(name, argument)
    assert line.startswith(f"{name}: error: {said}") and line.count("\n") == 1


def test_a_module_is_replaced(run):
    said = run("replace_a_module.py", 2)
    by_oracle, by_random = said.split("random planner\n  solved")
    assert by_oracle.startswith("oracle planner\n  solved 2 of 2")
    others = "termination: oracle, planner: oracle, controller: oracle"
    assert f"privileged, told the ground truth: estimator: oracle, {others}" in by_oracle
    assert "estimator: oracle, termination: oracle, controller: oracle" in by_random


@pytest.mark.parametrize("world", WORLDS)
def test_a_bag_is_replayed_in_the_world_that_it_names(run, oracles, tmp_path, world):
    spec = EpisodeSpec(generate_level(1, TRAIN_SEEDS.start), TRAIN_SEEDS.start)
    with Recorder(tmp_path / "bag", BALL, [spec], [1], world=world) as recorder:
        for tick in ticks(oracles.policy(), World(1, world=world, max_boxes=1), [spec], camera=True):
            recorder.write(tick)
    (bag,) = (tmp_path / "bag").iterdir()
    shutil.copytree(bag, tmp_path / "bag" / "again")
    said = f"seed {spec.seed}: {tick.step[0] + 1} ticks, at most 0.0e+00 apart\n"
    assert run("replay_a_bag.py", bag) == said and run("replay_a_bag.py", tmp_path / "bag") == 2 * said


def driven_at_random(folder, **room):
    """Record one episode of the first training level in a world with such room and time; return its bag."""
    spec = EpisodeSpec(generate_level(1, TRAIN_SEEDS.start), TRAIN_SEEDS.start)
    agent = Repeating(RandomAgent(), 10, BALL.action_size)
    with Recorder(folder, BALL, [spec], [1]) as recorder:
        for tick in ticks(AgentPolicy(agent), World(1, **room), [spec], camera=True):
            recorder.write(tick)
    (bag,) = folder.iterdir()
    return bag


def test_a_bag_is_replayed_with_room_for_as_many_boxes_as_it_was_recorded_with(run, tmp_path):
    """The solver's steps depend on it in the last bit."""
    bag = driven_at_random(tmp_path / "bag", max_boxes=4, time_limit=200)
    assert f"seed {TRAIN_SEEDS.start}: 200 ticks, at most 0.0e+00 apart" in run("replay_a_bag.py", bag)


def test_a_bag_of_longer_episodes_than_the_bodys_is_replayed_to_their_end(run, tmp_path, monkeypatch):
    bag = driven_at_random(tmp_path / "bag", max_boxes=1, time_limit=40)
    monkeypatch.setitem(BODIES, BALL.name, replace(BALL, time_limit=20))
    assert run("replay_a_bag.py", bag) == f"seed {TRAIN_SEEDS.start}: 40 ticks, at most 0.0e+00 apart\n"


def test_a_bag_of_levels_that_are_not_for_training_is_replayed_too(run, oracles, tmp_path):
    spec = EpisodeSpec(generate_level(1, PLAY_SEEDS.start), PLAY_SEEDS.start)
    with Recorder(tmp_path / "bag", BALL, [spec], [1]) as recorder:
        for tick in ticks(oracles.policy(), World(1, max_boxes=1, time_limit=3), [spec], camera=True):
            recorder.write(tick)
    (bag,) = (tmp_path / "bag").iterdir()
    assert run("replay_a_bag.py", bag) == f"seed {spec.seed}: 3 ticks, at most 0.0e+00 apart\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [((), "missing from replay_a_bag.py: PATH"), (("none",), "no bag at none: expected a bag or a folder of bags")],
)
def test_a_bag_that_is_missing_is_one_line(run, arguments, said):
    line = run("replay_a_bag.py", *arguments)
    assert line.startswith(f"replay_a_bag.py: error: {said}") and line.count("\n") == 1


def test_no_example_is_left_out():
    tested = Path(__file__).read_text()
    assert all(f'"{path.name}"' in tested for path in EXAMPLES.glob("*.py"))
