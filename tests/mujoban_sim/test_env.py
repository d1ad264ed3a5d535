import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import mujoban_sim  # noqa: F401 - registers the environment
from mujoban_core.grid import cell_to_xy
from mujoban_sim.checks import TorqueError
from mujoban_sim.env import OBSERVATION_SETS, MujobanEnv, draw_seed
from mujoban_sim.vector_env import MujobanVectorEnv
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, generate_level
from mujoban_sokoban.levels import Level

CORRIDOR = "######\n#@$ .#\n######\n"


@pytest.mark.parametrize("observations", OBSERVATION_SETS)
def test_gymnasiums_checker_passes(observations):
    env = gymnasium.make("Mujoban-v0", observations=observations, render_mode="rgb_array", difficulty=2)
    with warnings.catch_warnings():
        # Velocities have no bounds.
        warnings.filterwarnings("ignore", ".*infinity.*")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.filterwarnings("ignore:.*infinity.*")
def test_the_ant_is_an_environment_as_well():
    env = gymnasium.make("Mujoban-v0", difficulty=1, body="ant", world="reference", observations="state")
    check_env(env.unwrapped)
    assert env.action_space.shape == (8,) and env.observation_space["proprio"].shape == (28,)
    env.close()


def test_observations_have_the_documented_shapes():
    env = MujobanEnv(observations="privileged", difficulty=3)
    observation, info = env.reset(seed=3)
    assert {name: value.shape for name, value in observation.items()} == {
        "frame": (64, 64, 3), "top_down": (64, 64, 3), "proprio": (16,), "pose": (3,), "velocity": (3,),
        "box_position": (2, 2), "abstract_state": (10, 10, 4),
    }  # fmt: skip
    assert np.array_equal(observation["abstract_state"], generate_level(3, 3).abstract_state())
    assert info == {"seed": 3, "level": generate_level(3, 3).to_text()}
    env.close()


def test_a_seed_is_an_episode_and_without_one_no_test_level_is_played():
    env = MujobanEnv(observations="state")
    first, _ = env.reset(seed=4)
    drawn = [env.reset()[1]["seed"] for _ in range(3)]
    assert len(set(drawn)) == 3
    again, _ = env.reset(seed=4)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert [env.reset()[1]["seed"] for _ in range(3)] == drawn


class Lowest:
    """A generator that draws the lowest number of each range."""

    def integers(self, low, high, count):
        return np.full(count, low)


def test_seeds_are_drawn_beyond_those_of_validation_and_tests():
    assert draw_seed(Lowest()) == TRAIN_SEEDS.start > max(VALIDATION_SEEDS[-1], TEST_SEEDS[-1])


def test_what_a_reset_does_not_know_is_named():
    single, vector = MujobanEnv(observations="state"), MujobanVectorEnv(2, observations="state")
    with pytest.raises(ValueError, match=r"unknown options levl: expected level"):
        single.reset(options={"levl": CORRIDOR})
    with pytest.raises(ValueError, match=r"unknown options level: expected reset_mask"):
        vector.reset(options={"level": CORRIDOR})
    with pytest.raises(ValueError, match=r"level is a int: expected a Level or a level text"):
        single.reset(options={"level": 3})


def test_solving_terminates_and_the_time_limit_truncates():
    env = MujobanEnv(observations="state", time_limit=150)
    for seed in range(100):
        env.reset(seed=seed, options={"level": CORRIDOR})
        if abs(env.world.pose[0, 2]) < 0.05:
            break
    total, ended = 0.0, False
    for _ in range(150):
        _, reward, terminated, truncated, info = env.step(np.array([0.6, -env.world.pose[0, 2]], np.float32))
        total += reward
        ended = terminated or truncated
        if ended:
            break
    assert terminated and not truncated and total == 11.0 and info == {"solved": True, "boxes_on_target": 1}
    env.reset(seed=0)
    for _ in range(150):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
    assert truncated and not terminated


def test_levels_come_from_a_file(tmp_path):
    path = tmp_path / "levels.txt"
    path.write_text("; 0\n" + CORRIDOR + "\n; 1\n#####\n#@$.#\n#####\n")
    env = MujobanEnv(level_file=path, observations="state")
    assert env.reset(seed=2)[1]["level"] == Level.from_text(CORRIDOR).to_text()
    assert env.reset(seed=3)[1]["level"] != Level.from_text(CORRIDOR).to_text()
    played = [episode.level.to_text() for episode in Episodes(2, 3, level_file=path)]
    assert played == [env.reset(seed=seed)[1]["level"] for seed in (3, 4)]


def test_bad_options_and_actions_are_named():
    with pytest.raises(ValueError, match=r"difficulty 6.*1, 2, 3, 4, 5"):
        MujobanEnv(difficulty=6)
    with pytest.raises(ValueError, match=r"observation set 'all'.*default"):
        MujobanEnv(observations="all")
    with pytest.raises(ValueError, match="render_mode 'human'"):
        MujobanEnv(render_mode="human")
    env = MujobanEnv(observations="state")
    env.reset(seed=0)
    with pytest.raises(TorqueError):
        env.step(np.array([np.nan, 0.0], np.float32))


def test_render_shows_the_grid_from_above():
    env = MujobanEnv(observations="state", render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (256, 256, 3) and image.dtype == np.uint8 and image.std() > 5
    env.close()


def row_infos(infos, i):
    """The infos of environment i, as a single one would give them."""
    names = {"seed", "level", "solved", "boxes_on_target"} & infos.keys()
    return {name: infos[name][i] for name in names if infos[f"_{name}"][i]}


def test_vectorised_environments_behave_as_single_ones():
    options = {"observations": "state", "time_limit": 7, "difficulty": 2}
    vector = gymnasium.make_vec("Mujoban-v0", 3, vectorization_mode="vector_entry_point", threads=2, **options)
    singles = [MujobanEnv(**options) for _ in range(3)]
    observation, infos = vector.reset(seed=5)
    expected = [env.reset(seed=5 + i)[0] for i, env in enumerate(singles)]
    ended = [False] * 3
    rng = np.random.default_rng(0)
    for _ in range(25):
        for i, single in enumerate(expected):
            assert all(np.array_equal(single[name], observation[name][i]) for name in single)
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        observation, rewards, terminated, truncated, infos = vector.step(actions)
        for i, env in enumerate(singles):
            if ended[i]:
                (expected[i], info), reward, ended[i] = env.reset(), 0.0, False
            else:
                expected[i], reward, end, cut, info = env.step(actions[i])
                ended[i] = end or cut
            assert reward == rewards[i] and ended[i] == (terminated[i] or truncated[i])
            assert row_infos(infos, i) == info


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_solved_episode_is_reported_once(mode, tmp_path):
    path = tmp_path / "levels.txt"
    path.write_text(CORRIDOR)
    env = MujobanVectorEnv(2, observations="state", level_file=path, autoreset_mode=mode)
    env.reset(seed=0)
    # The box of row 0 is put on the pad, that of row 1 stays where it is.
    boxes = env.world.box_position.copy()
    boxes[0, 0] = cell_to_xy(np.argwhere(env.world.target[0])[0])
    env.world.place([0, 1], env.world.pose, boxes)
    still, reports = np.zeros((2, 2), np.float32), []
    for _ in range(3):
        *_, infos = env.step(still)
        reports += [row_infos(part, 0) for part in (infos, infos.get("final_info")) if part]
    assert sum(report.get("solved", False) for report in reports) == 1
    assert sum(report.get("boxes_on_target", 0) for report in reports) == 1


def test_same_step_autoreset_hands_over_the_last_observation():
    env = MujobanVectorEnv(2, observations="state", time_limit=4, autoreset_mode=AutoresetMode.SAME_STEP)
    env.reset(seed=0)
    for _ in range(4):
        observation, _, _, truncated, infos = env.step(np.full((2, 2), 0.3, np.float32))
    assert truncated.all() and (env.world.steps == 0).all()
    for i in range(2):
        assert infos["final_obs"][i]["pose"].shape == (3,)
        assert not np.array_equal(infos["final_obs"][i]["pose"], observation["pose"][i])


def test_disabled_autoreset_resets_where_the_mask_says():
    env = MujobanVectorEnv(2, observations="state", time_limit=2, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros((2, 2), np.float32))
    with pytest.raises(RuntimeError, match=r"\[0, 1\].*reset"):
        env.step(np.zeros((2, 2), np.float32))
    _, infos = env.reset(seed=[8, 9], options={"reset_mask": np.array([False, True])})
    assert infos["seed"][1] == 9 and not infos["_seed"][0]
    assert env.world.steps.tolist() == [2, 0]
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})


@pytest.mark.parametrize("carry", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium.make("Mujoban-v0", difficulty=2, time_limit=25),
        lambda: MujobanVectorEnv(2, difficulty=2, time_limit=25, autoreset_mode=AutoresetMode.NEXT_STEP),
    ],
)
def test_a_copy_continues_as_its_original_does_into_the_next_episodes(make, carry):
    env = make()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (30, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=3)
    for action in actions[:10]:
        env.step(action)
    twin = carry(env)

    def play(played):
        frames = []
        for action in actions[10:]:
            observation, reward, terminated, truncated, _ = played.step(action)
            if np.ndim(truncated) == 0 and (terminated or truncated):
                observation, _ = played.reset()
            frames.append((*observation.values(), reward, terminated, truncated))
        return frames

    for ours, theirs in zip(play(env), play(twin), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
    env.close()
    twin.close()


@pytest.mark.parametrize("make", [MujobanEnv, MujobanVectorEnv])
def test_a_closed_environment_says_so(make):
    env = make(observations="state", difficulty=1, render_mode="rgb_array")
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (lambda: env.step(np.zeros(env.action_space.shape, np.float32)), env.render, env.reset):
        with pytest.raises(ClosedEnvironmentError, match="the environment is closed: make a new one"):
            call()
