"""Bags of the graph: complete, equal from run to run, and good for playing back."""

from dataclasses import replace

import pytest
from mujoban_msgs.msg import AbstractState
from rclpy.serialization import deserialize_message

from bringup.graph_recorder import RecorderNode
from bringup.results import told_roles
from bringup.rollout import ticks
from bringup.rollout_recorder import TOPICS as ROLLOUT_TOPICS
from bringup.rollout_recorder import Recorder
from bringup.stack import PlayOptions, play
from mujoban_controller.node import ControllerNode
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError, open_bag
from mujoban_msgs_py.conversions import stamp_of
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_msgs_py.topics import GRAPH_TOPICS, MODULE_TOPICS, SIMULATOR_TOPICS, TICK
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


def contents(path):
    return [(m.topic, m.stamp, m.data) for m in open_bag(path).messages()]


@pytest.fixture(scope="module")
def bags(tmp_path_factory, oracles, fresh_weights):
    """Record the same three episodes twice, with the learned estimator."""
    folder = tmp_path_factory.mktemp("bags")
    stack = replace(oracles, choices=oracles.choices | {"estimator": fresh_weights.choices["estimator"]})
    for name in ("first", "second"):
        play(stack, Episodes(3, 0, difficulty=1), PlayOptions(record=folder / name, episodes_per_file=2, time_limit=20))
    return folder / "first", folder / "second"


def test_a_lockstep_bag_lacks_nothing(bags):
    bag = open_bag(bags[0])
    messages = contents(bags[0])
    stamps = sorted({stamp for _, stamp, _ in messages})
    assert stamps == list(range(TICK, stamps[-1] + 1, TICK))
    for name in GRAPH_TOPICS:
        said = [stamp for topic, stamp, _ in messages if topic == name]
        ends = 3 if name in {t.name for t in MODULE_TOPICS} else 0
        assert len(said) == len(set(said)) == len(stamps) - ends, name
    assert [len(SIMULATOR_TOPICS), len(MODULE_TOPICS)] == [13, 4]
    assert len(bag.files) == 2, "one file for two episodes"


def test_two_runs_give_the_same_bag(bags):
    assert contents(bags[0]) == contents(bags[1])


def said(bag):
    """Return what each topic of a rollout's bag said, by stamp."""
    found = {topic.name: {} for topic in ROLLOUT_TOPICS}
    for topic, stamp, data in contents(bag):
        if topic in found:
            found[topic][stamp] = deserialize_message(data, GRAPH_TOPICS[topic].type)
    return found


def test_the_graph_and_the_rollout_record_the_same_of_an_episode(oracles, tmp_path):
    episodes = Episodes(2, 3, difficulty=1)
    results = play(oracles, episodes, PlayOptions(record=tmp_path / "graph", time_limit=200)).results
    assert results[0].solved
    world = World(1, max_boxes=episodes.max_boxes, time_limit=200)
    roles = told_roles(oracles.identities())
    with Recorder(tmp_path, world.body, episodes, [1, 1], privileged=roles) as recorder:
        for tick in ticks(oracles.policy(), world, episodes, camera=True):
            recorder.write(tick)
    assert open_bag(tmp_path / "graph").about == open_bag(tmp_path / "row000").about
    assert open_bag(tmp_path / "graph").about == {
        "body": "ball", "world": DEFAULT_WORLD, "privileged": "estimator, termination, planner, controller",
        "max_boxes": "1",
    }  # fmt: skip
    graph, rollout = said(tmp_path / "graph"), said(tmp_path / "row000")
    for topic in graph:
        assert graph[topic] == rollout[topic], topic
    last = [m for m in rollout[topics.TRUE_EPISODE.name].values() if m.solved]
    assert last[0].boxes_on_target == 1 and last[0].reward > 10


def test_messages_carry_the_stamp_that_they_are_logged_with(bags):
    for value in open_bag(bags[0]).read([topics.EPISODE.name]):
        assert value.stamp % TICK == 0
    tick = next(iter(open_bag(bags[0]).ticks([topics.CAMERA, topics.ABSTRACT_STATE, topics.TORQUE])))
    assert tick.stamp == TICK and tick.values[0].shape == (64, 64, 3)


def test_playing_a_bag_back_into_the_estimator_reproduces_its_estimates(bags, play_graph, oracles, fresh_weights):
    stack = replace(oracles, choices=oracles.choices | {"estimator": fresh_weights.choices["estimator"]})
    graph = play_graph(stack, names=["estimator"])
    replayed = {}
    graph.tap.create_subscription(
        AbstractState, topics.ABSTRACT_STATE.name, lambda m: replayed.__setitem__(stamp_of(m), m), live_qos(1000)
    )
    inputs = {t.name: graph.tap.create_publisher(t.type, t.name, t.qos) for t in
              (topics.EPISODE, topics.CAMERA, topics.POSE)}  # fmt: skip
    graph.spin_until(lambda: all(p.get_subscription_count() for p in inputs.values()))
    recorded = {}
    for name, stamp, data in contents(bags[0]):
        if name in inputs:
            inputs[name].publish(data)
        elif name == topics.ABSTRACT_STATE.name:
            recorded[stamp] = deserialize_message(data, AbstractState)
            graph.spin_until(lambda expected=stamp: expected in replayed)
    assert replayed == recorded and len(recorded) == 60


def test_a_bag_is_not_written_over(bags, ros):
    from rclpy.parameter import Parameter

    with pytest.raises(BagError, match="exists already"):
        RecorderNode(parameter_overrides=[Parameter("path", value=str(bags[0]))])


def test_in_real_time_what_was_not_recorded_is_counted(play_graph, tmp_path):
    from rclpy.parameter import Parameter

    names = ["simulator", "estimator", "termination", "planner", "controller"]
    graph = play_graph(names=names, realtime=4.0, resend_after=10.0, hold_limit=100)
    path = Parameter("path", value=str(tmp_path / "bag"))
    graph.spin_until(lambda: graph.simulator.ticks >= 3)
    recorder = graph.graph.add(RecorderNode(parameter_overrides=[path]))
    graph.spin_until(lambda: recorder.written)
    graph.graph.stop("controller")
    graph.spin_until(lambda: recorder.counts["/torque not recorded"] >= 3)


def test_what_a_bag_in_real_time_lacks_is_in_the_outcome(oracles, tmp_path, monkeypatch):
    step = ControllerNode.step

    def now_and_then(node, episode, inputs, truth):
        return () if episode.step % 4 == 1 else step(node, episode, inputs, truth)

    monkeypatch.setattr(ControllerNode, "step", now_and_then)
    options = PlayOptions(record=tmp_path / "bag", realtime=4.0, time_limit=12)
    counts = play(oracles, Episodes(1, 47, difficulty=2), options).counts
    assert counts["recorder: /torque not recorded"] >= 3
