"""Modules that try to cheat: a plugin for each role that collects whatever it can reach of the truth."""

import textwrap
from pathlib import Path

import numpy as np
import pytest
import yaml
from mujoban_msgs.msg import EpisodeTruth
from rich.console import Console

from bringup.command import Choice, Stack
from bringup.graph import Processes
from bringup.monitor import Watched
from bringup.parameters import graph_parameters
from bringup.results import EpisodeResult, report
from bringup.rollout import rollout
from bringup.view import live_view
from mujoban_core.interfaces import module_seeds
from mujoban_core.plugins import ROLES
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import InstructionReading, TerminationReading
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

CHEATERS = """
import numpy as np
from mujoban_core import interfaces

FOUND = {"seeds": [], "truth": [], "fields": set()}

class Cheat:
    privileged = False
    def initial_memory(self, batch):
        return ()
    def initial_state(self, seeds):
        FOUND["seeds"].append(np.array(seeds))
        return super().initial_state(seeds)
    def look(self, inputs):
        self.privileged = True  # too late
        FOUND["truth"].append(inputs.truth)
        FOUND["fields"].update(inputs._fields)

class Estimator(Cheat, interfaces.Estimator):
    def step(self, inputs, state):
        self.look(inputs)
        return np.zeros((len(inputs.pose), 10, 10, 4), np.float32), state

class Termination(Cheat, interfaces.Termination):
    def probability(self, inputs, memory):
        self.look(inputs)
        return np.zeros(len(inputs.instruction), np.float32), memory

class Planner(Cheat, interfaces.Planner):
    def decide(self, abstract_state, memory):
        FOUND["truth"].append(abstract_state if abstract_state.any() else None)
        return np.zeros(len(abstract_state), np.int64), memory

class Controller(Cheat, interfaces.Controller):
    def step(self, inputs, state):
        self.look(inputs)
        return np.zeros((len(inputs.instruction), 2), np.float32), state

class Confessing(Planner):
    privileged = True
"""
PUBLIC = {"frame", "pose", "proprio", "instruction", "terminated", "truth"}


@pytest.fixture
def cheaters(tmp_path, monkeypatch):
    (tmp_path / "cheaters.py").write_text(textwrap.dedent(CHEATERS))
    monkeypatch.syspath_prepend(tmp_path)
    import cheaters

    for kept in cheaters.FOUND.values():
        kept.clear()
    return cheaters


def stack():
    return Stack({role: Choice(role, f"cheaters:{role.capitalize()}") for role in ROLES}, look_around=0)


def check_found(cheaters, episodes):
    found = cheaters.FOUND
    assert found["truth"] and all(truth is None for truth in found["truth"])
    assert found["fields"] <= PUBLIC
    # The same whatever the levels are: four modules, and the streams of the first and the second episode.
    assert {seed for seeds in found["seeds"] for seed in seeds.tolist()} == set(module_seeds(0, np.array([1, 2])))
    assert not {spec.seed for spec in episodes} & {seed for seeds in found["seeds"] for seed in seeds.tolist()}


@pytest.mark.parametrize("seed", [7, 123])
def test_in_a_rollout_a_cheating_plugin_finds_nothing(cheaters, seed):
    episodes = Episodes(2, seed, difficulty=1)
    results = rollout(stack().policy(), World(1, max_boxes=1, time_limit=6), episodes)
    assert not any(result.solved for result in results)
    check_found(cheaters, episodes)


def test_in_the_graph_a_cheating_plugin_finds_nothing(cheaters, play_graph):
    episodes = Episodes(2, 123, difficulty=1)
    graph = play_graph(stack(), episodes, time_limit=6)
    graph.finish()
    check_found(cheaters, episodes)
    hidden = {topic.name for topic in (*topics.TRUTH_TOPICS, topics.TOP_CAMERA)}
    nodes = [graph.graph.nodes[role] for role in ROLES]
    for node in nodes:
        assert isinstance(node, ModuleNode)
        assert not hidden & {subscription.topic_name for subscription in node.subscriptions}
        # What a module is given besides its inputs would show on it.
        assert vars(node.module).keys() <= {"limit", "sample", "threshold", "privileged"}
    public = set(topics.EPISODE.type.get_fields_and_field_types())
    assert public == {"header", "episode", "step", "ended"}


def test_the_process_of_a_module_is_not_told_what_the_simulators_is(ros):
    with Processes(graph_parameters(stack(), Episodes(1, 123, difficulty=1))) as processes:
        for role in ROLES:
            # What a plugin finds in its command line leads to this file, and to what lies beside it.
            path = Path(processes._children[role].args[-1])
            (told,) = yaml.safe_load(path.read_text()).items()
            assert told[0] == role and not {"seed", "difficulty", "level_file"} & told[1]["ros__parameters"].keys()
            assert not [file for file in path.parent.iterdir() if "simulator" in file.name]


def test_a_plugin_that_is_told_the_truth_is_named_so_everywhere(cheaters):
    identities = stack().identities() | {"planner": Choice("planner", "cheaters:Confessing").identity()}
    assert identities["planner"] == "cheaters:Confessing (privileged)"
    outcome = EpisodeResult(0, False, 0.0, 6, 1, 0, 0, None)
    assert report([outcome], identities)["privileged"] == ["planner"]
    state = np.zeros((10, 10, 4), np.float32)
    values = {
        topics.INSTRUCTION.name: InstructionReading(1, 0),
        topics.TERMINATION.name: TerminationReading(1, 0.0, False, False),
        topics.ABSTRACT_STATE.name: state, topics.TRUE_ABSTRACT_STATE.name: state,
    }  # fmt: skip
    console = Console(width=120, record=True)
    console.print(live_view(EpisodeTruth(), Watched(values), [], identities))
    (line,) = [line for line in console.export_text().splitlines() if "privileged" in line]
    assert "planner" in line
