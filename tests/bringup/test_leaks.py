"""Plugins that try to cheat: one for each role, a scout and an agent, which collect what they can reach of the truth.

They ask too late, or otherwise than they said, look at every field that they are given and at what lies behind it, keep
it, write into it, and read the command line. One opens a node of its own, which hears the truth and is named. What
docs/security.md leaves to the user is not tried: the interpreter's memory (`gc`, frames), other processes and files,
and levels made from guessed seeds.
"""

import subprocess
import sys
import textwrap
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from bringup import run_stack
from bringup.command import Choice, Solo, Stack
from bringup.evaluate import evaluate
from bringup.graph import Processes
from bringup.monitor import Watched
from bringup.parameters import graph_parameters
from bringup.results import EpisodeResult, report
from bringup.rollout import rollout
from bringup.stack import PlayOptions, play
from bringup.view import live_view
from mujoban_core import plugins
from mujoban_core.interfaces import module_seeds
from mujoban_core.plugins import AGENT, ROLES, SCOUT
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import EpisodeTruthReading, InstructionReading, TerminationReading
from mujoban_msgs_py.listening import OVERHEARD
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

CHEATERS = """
import sys
import numpy as np
from mujoban_core import agent, interfaces, look_around
from mujoban_sokoban.generator import generate_level

FOUND = {"seeds": [], "truth": [], "fields": set(), "behind": [], "kept": [], "scouted": []}

def behind(thing):
    # What leads on from something that a module is given: fields, attributes, the memory of arrays.
    names = (*getattr(thing, "_fields", ()), *getattr(thing, "__dict__", ()), "base", "obj")
    return [value for value in (getattr(thing, name, None) for name in names) if value is not None]

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
        self.search(behind(inputs))
    def search(self, values):
        for value in values:
            reached = [(value.nbytes, further) for further in behind(value)]
            while reached:
                own, thing = reached.pop()
                FOUND["behind"].append((own, thing))
                reached += [(own, further) for further in behind(thing)]
            if value.flags.writeable:
                value.fill(1)  # moves the robot, if this were the world's
            FOUND["kept"].append((value, value.copy()))

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
        self.search([abstract_state])
        return np.zeros(len(abstract_state), np.int64), memory

class Controller(Cheat, interfaces.Controller):
    def step(self, inputs, state):
        self.look(inputs)
        return np.zeros((len(inputs.instruction), 2), np.float32), state

class Peek(Planner):
    # Makes the levels from the command line and from the numbers of the episodes, which random streams are drawn from.
    def initial_state(self, seeds):
        told, levels = [*sys.argv, *sys.orig_argv], []
        streams = interfaces.module_seeds(0, np.arange(1, 9)).tolist()
        if "--seed" in told and "--difficulty" in told:
            first, difficulty = (int(told[told.index(name) + 1]) for name in ("--seed", "--difficulty"))
            levels = [generate_level(difficulty, first + streams.index(seed)).to_text() for seed in seeds.tolist()]
        with open("peeked.txt", "a") as file:
            print("peeked", *levels, sep="\\n", file=file)
        return super().initial_state(seeds)

class Listening(Planner):
    # Hears the truth by a node of its own.
    def __init__(self):
        import rclpy
        from mujoban_msgs_py import topics
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        truth = topics.TRUE_EPISODE
        self.node = rclpy.create_node("spy", context=self.context)
        self.node.create_subscription(truth.type, truth.name, print, truth.qos)

class Confessing(Planner):
    privileged = True

class Shifty(Controller):
    asks = []  # of each instance
    def __init__(self):
        self.privileged = self.asks.pop(0)

class Flickering(Controller):
    asked = 0
    @property
    def privileged(self):
        self.asked += 1
        return self.asked > 1
    @privileged.setter
    def privileged(self, value):
        pass

class Deciding(Termination):
    def probability(self, inputs, memory):
        return super().probability(inputs, memory)[0] + 1, memory

class Scout(Cheat, look_around.Scout):
    def step(self, abstract_state, shown):
        FOUND["truth"].append(abstract_state if abstract_state.any() else None)
        FOUND["scouted"].append(abstract_state.shape)
        self.search([abstract_state, shown])
        return None

class Sly(Cheat, agent.Agent):
    sees = ("pose", "abstract_state")
    def step(self, inputs, state):
        FOUND["truth"].append(inputs.abstract_state)
        self.search(behind(inputs))
        return np.zeros((len(inputs.pose), 2), np.float32), state

class Growing(Sly):
    looks = 0
    @property
    def sees(self):
        self.looks += 1
        return ("pose",) if self.looks == 1 else Sly.sees
"""
PUBLIC = {"frame", "pose", "proprio", "instruction", "terminated", "truth"}


@pytest.fixture
def cheaters(tmp_path, monkeypatch):
    (tmp_path / "cheaters.py").write_text(textwrap.dedent(CHEATERS))
    monkeypatch.syspath_prepend(tmp_path)
    import cheaters

    yield cheaters
    del sys.modules["cheaters"]


def stack(*, look_around=0, **others):
    names = {role: role.capitalize() for role in ROLES} | others
    choices = {role: Choice(role, f"cheaters:{name}") for role, name in names.items()}
    return Stack(choices, look_around=look_around, scout=Choice(SCOUT, "cheaters:Scout"))


def solo(name):
    return Solo(Choice(AGENT, f"cheaters:{name}"))


def check_found(cheaters, episodes):
    found = cheaters.FOUND
    assert found["truth"] and all(truth is None for truth in found["truth"])
    assert found["fields"] <= PUBLIC
    # Behind an array lies its own memory and no more, and nobody writes into it later.
    assert all(len(memoryview(thing).cast("B")) <= own for own, thing in found["behind"])
    assert found["kept"] and all(np.array_equal(array, copy) for array, copy in found["kept"])
    # The same whatever the levels are: four modules, and the streams of the first and the second episode.
    assert {seed for seeds in found["seeds"] for seed in seeds.tolist()} == set(module_seeds(0, np.array([1, 2])))
    assert not {spec.seed for spec in episodes} & {seed for seeds in found["seeds"] for seed in seeds.tolist()}


@pytest.mark.parametrize(
    ("seed", "player"),
    [(7, stack), (123, partial(stack, controller="Flickering")), (123, partial(solo, "Growing"))],
    ids=["modules", "flickering", "agent"],
)
def test_in_a_rollout_a_cheating_plugin_finds_nothing(cheaters, seed, player):
    episodes = Episodes(2, seed, difficulty=1)
    world, untouched = (World(1, max_boxes=1, time_limit=6) for _ in range(2))
    results = rollout(player().policy(), world, episodes)
    assert not any(result.solved for result in results)
    check_found(cheaters, episodes)
    untouched.reset([0], [episodes[1]])
    for _ in range(6):
        untouched.step(np.zeros((1, 2), np.float32))
    assert np.array_equal(world.pose, untouched.pose), "what a plugin writes into its inputs moves nothing"


def test_a_cheating_scout_finds_nothing_and_changes_nothing_that_the_planner_goes_by(cheaters, play_graph):
    looking, episodes = stack(look_around=1, termination="Deciding"), Episodes(2, 123, difficulty=1)
    rollout(looking.policy(), World(2, max_boxes=1, time_limit=6), episodes)
    alone = len(cheaters.FOUND["scouted"])
    play_graph(looking, episodes, time_limit=6).finish()
    assert 0 < alone < len(cheaters.FOUND["scouted"]) and set(cheaters.FOUND["scouted"]) == {(10, 10, 4)}
    check_found(cheaters, episodes)


@pytest.mark.parametrize("controller", ["Controller", "Flickering"])
def test_in_the_graph_a_cheating_plugin_finds_nothing(cheaters, play_graph, controller):
    episodes = Episodes(2, 123, difficulty=1)
    graph = play_graph(stack(controller=controller), episodes, time_limit=6)
    graph.finish()
    check_found(cheaters, episodes)
    hidden = {topic.name for topic in (*topics.TRUTH_TOPICS, topics.TOP_CAMERA)}
    nodes = [graph.graph.nodes[role] for role in ROLES]
    for node in nodes:
        assert isinstance(node, ModuleNode)
        assert not hidden & {subscription.topic_name for subscription in node.subscriptions}
        # What a module is given besides its inputs would show on it.
        assert vars(node.module).keys() <= {"limit", "sample", "threshold", "privileged", "asked"}
    public = set(topics.EPISODE.type.get_fields_and_field_types())
    assert public == {"header", "episode", "step", "ended"}


def test_a_plugin_that_hears_the_truth_by_a_node_of_its_own_is_found_out(cheaters, play_graph):
    graph = play_graph(stack(planner="Listening"), Episodes(1, 123, difficulty=1), time_limit=6)
    try:
        graph.spin_until(lambda: graph.monitor.truth_watch.seen == {"/tap", "/spy"})
        assert graph.monitor.counts[OVERHEARD] == 2
    finally:
        graph.graph.nodes["planner"].module.context.try_shutdown()


def test_the_process_of_a_module_is_not_told_what_the_simulators_is(ros, cheaters):
    with Processes(graph_parameters(stack(), Episodes(1, 123, difficulty=1))) as processes:
        for role in ROLES:
            # What a plugin finds in its command line leads to this file, and to what lies beside it.
            path = Path(processes._children[role].args[-1])
            (told,) = yaml.safe_load(path.read_text()).items()
            assert told[0] == role and not {"seed", "difficulty", "level_file"} & told[1]["ros__parameters"].keys()
            assert not [file for file in path.parent.iterdir() if "simulator" in file.name]


@pytest.mark.parametrize(
    "command",
    [("evaluate.py",), ("run_stack.py", "--headless"), ("run_stack.py", "--headless", "--processes")],
    ids=["rollout", "graph", "processes"],
)
def test_a_plugin_does_not_learn_of_the_level_from_the_command_line(cheaters, tmp_path, monkeypatch, command):
    level = Episodes(1, 5_000_123, difficulty=1)[0].level.to_text()
    options = ["--episodes", "1", "--seed", "5000123", "--difficulty", "1", "--time-limit", "6"]
    peeked, (program, *others) = tmp_path / "peeked.txt", command
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as context:
        context.setattr(sys, "argv", [program, *options])
        cheaters.Peek().initial_state(module_seeds(0, np.array([1])))
    assert level in peeked.read_text(), "what it would find"
    peeked.unlink()
    found = Path(run_stack.__file__).with_name(program)
    players = ["--planner", "cheaters:Peek", "--oracle", "estimator,termination,controller"]
    subprocess.run([sys.executable, found, *options, *players, *others], check=True, capture_output=True, timeout=120)
    assert set(peeked.read_text().splitlines()) == {"peeked"}


def test_an_instance_that_asks_otherwise_than_the_one_that_reports_name_does_not_play(cheaters, play_graph):
    def named(*asks):
        cheaters.Shifty.asks[:] = asks
        shifty = stack(controller="Shifty")
        return shifty, shifty.identities()["controller"]

    hidden, name = named(False, True, False, True)
    assert name == "cheaters:Shifty"
    with pytest.raises(ValueError, match="controller cheaters:Shifty asks for the ground truth where another"):
        hidden.policy()
    graph = play_graph(hidden, names=["controller"])
    graph.graph.stop("controller")
    with pytest.raises(ValueError, match="controller cheaters:Shifty asks for the ground truth where another"):
        graph.graph.start("controller")  # as after a crash
    confessed, name = named(True, False, True, False)
    assert name == "cheaters:Shifty (privileged)"
    with pytest.raises(ValueError, match="controller cheaters:Shifty does not ask for the ground truth where another"):
        confessed.policy()
    assert confessed.policy().told == {"controller"}


def test_an_agent_that_denies_what_it_sees_is_named_by_it(cheaters):
    sly = solo("Sly")
    assert sly.identities() == {AGENT: "cheaters:Sly (privileged)"} and sly.policy().privileged
    episodes = Episodes(2, 123, difficulty=1)
    growing = solo("Growing")
    assert growing.identities() == {AGENT: "cheaters:Growing"}
    assert play(growing, episodes, PlayOptions(time_limit=6)).results == evaluate(
        growing.policy(), episodes, time_limit=6
    )
    assert len(cheaters.FOUND["truth"]) == 18
    check_found(cheaters, episodes)


def test_what_a_distribution_calls_scripted_is_named_by_what_it_asks_for(cheaters, monkeypatch):
    offered = EntryPoint("planner.scripted", "cheaters:Confessing", plugins.GROUP)
    monkeypatch.setattr(plugins, "_offered", lambda: {offered.name: offered})
    assert Choice("planner", "scripted").identity() == "scripted (privileged)"


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
    episode = EpisodeTruthReading(
        1, 0, 5, level="", step=0, reward=0.0, episode_return=0.0, solved=False, terminated=False, truncated=False,
        boxes_on_target=0,
    )  # fmt: skip
    console = Console(width=120, record=True)
    console.print(live_view(episode, Watched(values), [], identities))
    (line,) = [line for line in console.export_text().splitlines() if "privileged" in line]
    assert "planner" in line
