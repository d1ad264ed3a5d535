"""Agents that play alone: on the same levels, with the same report, seeing what they ask for and nothing else."""

import json

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from bringup import run_stack
from bringup.command import Choice, Solo
from bringup.evaluate import evaluate, main
from bringup.results import Failure
from bringup.stack import PlayOptions, play
from mujoban_baselines.agents import StructuredAgent, playing, untrained
from mujoban_baselines.random_agent import RandomAgent
from mujoban_baselines.repeat import Repeating
from mujoban_core.agent import Agent, AgentInput, AgentPolicy
from mujoban_core.bodies import BODIES
from mujoban_core.interfaces import GroundTruth, Observation
from mujoban_msgs_py.bags import open_bag
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import TRAIN_SEEDS
from mujoban_sokoban.levels import Level, write_levels


class Watcher(Agent):
    """Notes what it is shown, and drives straight on."""

    def __init__(self, sees=("frame", "proprio", "pose")):
        self.sees = sees
        self.shown = []

    def initial_memory(self, batch):
        return (np.zeros(batch, np.int64),)

    def step(self, inputs: AgentInput, state):
        (ticks,) = state
        self.shown.append((inputs, ticks))
        torque = np.zeros((len(ticks), 2), np.float32)
        torque[:, 0] = 1.0
        return torque, (ticks + 1,)


@pytest.mark.parametrize("sees", [("frame", "proprio", "pose"), ("top_down", "abstract_state"), ("pose",)])
def test_an_agent_is_shown_what_it_asks_for_and_nothing_else(sees):
    agent = Watcher(sees)
    evaluate(AgentPolicy(agent), Episodes(3, 0, difficulty=1), batch=2, time_limit=3)
    shown, ticks = agent.shown[0]
    assert {name for name, value in shown._asdict().items() if value is not None} == set(sees)
    assert all(len(getattr(shown, name)) == 2 for name in sees)
    assert agent.privileged == ("top_down" in sees)
    assert ticks.tolist() == [0, 0] and agent.shown[3][1].tolist() == [0], "each episode starts with fresh memory"


def test_what_is_privileged_never_reaches_an_agent_that_does_not_declare_it():
    observation = Observation(np.zeros((1, 64, 64, 3), np.uint8), np.zeros((1, 16)), np.zeros((1, 3)))
    truth = GroundTruth(*(np.zeros((1, 1)) for _ in range(5)))
    agent = Watcher(("pose",))
    AgentPolicy(agent).step(observation, truth, agent.initial_memory(1))
    assert agent.shown[0][0].abstract_state is None
    blind = Watcher(("top_down",))
    with pytest.raises(ValueError, match="sees top_down, which is missing"):
        AgentPolicy(blind).step(observation, truth, blind.initial_memory(1))
    with pytest.raises(ValueError, match="sees 'smell': expected some of frame"):
        AgentPolicy(Watcher(("smell",))).step(observation, truth, ())


LANE = """\
######
#@$ .#
######
"""
CORNER = """\
#######
#.    #
#     #
#  @$ #
#######
"""


def test_an_agent_that_pushes_a_box_home_is_rewarded_and_one_that_pushes_it_into_a_corner_has_lost(tmp_path):
    outcomes = []
    for text in (LANE, CORNER):
        path = tmp_path / "level.txt"
        write_levels(path, [Level.from_text(text)])
        agent = AgentPolicy(Eastward())
        outcomes += evaluate(agent, Episodes(1, 0, level_file=path), time_limit=400)
    solved, lost = outcomes
    assert solved.solved and solved.episode_return == pytest.approx(11.0) and solved.failure is None
    assert not lost.solved and lost.failure == Failure.LEVEL_LOST


class Eastward(Agent):
    """Turns east, then drives; sees the pose alone."""

    sees = ("pose",)

    def initial_memory(self, batch):
        return ()

    def step(self, inputs: AgentInput, state):
        yaw = inputs.pose[:, 2]
        steer = np.clip(-2.0 * np.sin(yaw / 2), -1.0, 1.0)
        roll = np.where((np.cos(yaw) > 0.97), 0.8, 0.0)
        return np.stack([roll, steer], -1).astype(np.float32), state


class BallOnly(RandomAgent):
    """Has learned nothing, but with one body."""

    config = {"body": "ball"}  # noqa: RUF012 - as the networks declare it


@pytest.mark.parametrize("body", BODIES)
def test_a_named_agent_is_evaluated_with_the_report_of_the_stack(body, tmp_path, capsys):
    file = tmp_path / "report.json"
    played = ["--agent", "random", "--difficulty", "1", "--episodes", "3", "--time-limit", "20", "--json", str(file)]
    played += ["--body", body]
    assert main(played) == 0
    assert '"agent": "random"' in file.read_text() and '"success_interval"' in file.read_text()
    assert "solved 0 of 3" in capsys.readouterr().out


def test_contradictions_and_unknown_agents_are_one_line():
    with pytest.raises(ValueError, match=r"--agent random --planner: expected one of the two"):
        main(["--agent", "random", "--planner", "oracle"])
    for option, value in {"look-ahead": "4", "look-around": "50", "thinking": "2", "scout": "mine:Scout"}.items():
        with pytest.raises(ValueError, match=rf"--agent random --{option}: expected one of the two"):
            main(["--agent", "random", f"--{option}", value])
    with pytest.raises(ValueError, match="no agent is named 'nobody'"):
        Solo(Choice.parse("agent", "nobody")).policy()
    with pytest.raises(ValueError, match="trained for the body ball"):
        Solo(Choice.parse("agent", f"{__name__}:BallOnly"), body="ant").policy()
    with pytest.raises(ValueError, match=r"expected a \.safetensors file"):
        Solo(Choice.parse("agent", "learned")).policy()


def test_an_agent_plays_through_the_graph_as_it_does_in_a_rollout():
    episodes = Episodes(2, 3, difficulty=1)
    for name in ("random", f"{__name__}:MapReader"):
        solo = Solo(Choice.parse("agent", name))
        outcome = play(solo, episodes, PlayOptions(time_limit=25))
        assert outcome.results == evaluate(solo.policy(), episodes, time_limit=25)
        assert outcome.ticks == 50 and not any("foreign" in event for event in outcome.counts)


@pytest.mark.parametrize("name", ["untrained", "structured"])
def test_noise_subgoals_and_torques_that_are_held_are_in_the_graph_what_they_are_in_a_rollout(name):
    solo, episodes = Solo(Choice.parse("agent", f"{__name__}:noted_{name}")), Episodes(2, 3, difficulty=1)
    TORQUES.clear()
    played = play(solo, episodes, PlayOptions(time_limit=25)).results
    in_graph = np.concatenate(TORQUES)
    TORQUES.clear()
    assert played == evaluate(solo.policy(), episodes, batch=1, time_limit=25)
    in_rollout = np.concatenate(TORQUES)
    np.testing.assert_allclose(in_graph, in_rollout, atol=1e-4)
    assert (in_rollout[:4] == in_rollout[0]).all() and np.unique(in_rollout, axis=0).shape == (14, 2)


TORQUES = []


class Noted(Repeating):
    """Notes what it says."""

    def step(self, inputs, state):
        torque, state = super().step(inputs, state)
        TORQUES.append(torque)
        return torque, state


def noted_untrained():
    agent = untrained()
    return Noted(agent.inner, agent.ticks, 2)


def noted_structured():
    """Has subgoals in its memory, too."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        agent = playing(StructuredAgent(repeat=4, draws="pink").eval())
    return Noted(agent.inner, agent.ticks, 2)


def test_an_agent_is_played_filmed_and_recorded_in_the_place_of_the_modules(tmp_path, capfd):
    report, bag, film = tmp_path / "out.json", tmp_path / "bag", tmp_path / "film.mp4"
    played = ["--agent", "random", "--difficulty", "1", "--time-limit", "10", "--seed", str(TRAIN_SEEDS.start)]
    kept = ["--json", str(report), "--record", str(bag), "--video", str(film)]
    assert run_stack.main([*played, *kept]) == 0
    out = capfd.readouterr().out
    assert "torque" in out and "ground truth" in out and "solved 0 of 1" in out
    content = json.loads(report.read_text())
    assert content["weights"] == {"agent": "random"} and content["episodes"][0]["steps"] == 10
    late = {"simulator: repeated ticks"}  # a busy machine answers late
    assert not content["counts"].keys() - late, "nothing was missed"
    held = {name: info.count for name, info in open_bag(bag).topics.items()}
    assert held["/torque"] == 10 and held["/camera/image_raw"] == 11 and not held.get("/instruction")
    assert imageio.get_reader(film).count_frames() == 11
    with pytest.raises(ValueError, match=r"--agent random --planner: expected one of the two"):
        run_stack.main(["--agent", "random", "--planner", "oracle"])


class MapReader(Eastward):
    """Drives by the true map: privileged."""

    sees = ("pose", "abstract_state", "top_down")

    def step(self, inputs: AgentInput, state):
        assert inputs.top_down.shape == (1, 64, 64, 3) or len(inputs.pose) > 1
        torque, state = super().step(inputs, state)
        return torque * inputs.abstract_state[..., 1].any((1, 2))[:, None], state
