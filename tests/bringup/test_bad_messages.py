"""Whatever anybody publishes on the graph's topics, the episode goes on, and the stranger is named."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from rclpy.impl import rcutils_logger
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from benchmarks.malformed import TARGETS, Vandal
from benchmarks.malformed_calls import Caller
from bringup.graph_recorder import RecorderNode
from bringup.viz import VizNode
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import open_bag
from mujoban_msgs_py.decoders import DECODERS
from mujoban_msgs_py.listening import ANOTHER_RUN, OVERHEARD, Received, reject
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import generate_level


@pytest.mark.parametrize("realtime", [0.0, 8.0])
def test_spoiled_messages_on_every_topic_end_nothing_and_what_is_recorded_is_sound(play_graph, tmp_path, realtime):
    graph = play_graph(
        episodes=Episodes(2, 0, difficulty=1), await_recorder=realtime == 0, time_limit=100, realtime=realtime
    )
    path = Parameter("path", value=str(tmp_path / "bag"))
    recorder = graph.graph.add(RecorderNode(parameter_overrides=[path]))
    viz = graph.graph.add(VizNode())
    vandal = graph.graph.add(Vandal(np.random.default_rng(0)))
    graph.spin_until(lambda: graph.simulator.ticks >= 5)
    while not graph.monitor.finished.done() and vandal.sent["/clock"] < 400:
        vandal.act(4)
        before = graph.simulator.ticks
        graph.spin_until(lambda b=before: graph.simulator.ticks > b or graph.monitor.finished.done(), timeout=20.0)
    assert graph.finish()
    for node in (recorder, viz, *graph.graph.nodes.values()):
        assert node.counts["rejected messages"] >= 3, node.get_name()
    graph.graph.end(recorder)
    assert sum(1 for _ in open_bag(tmp_path / "bag").read()) > 100, "every recorded message can be read"


def test_spoiled_calls_of_every_service_end_nothing_and_all_are_answered(play_graph):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    nodes = {"simulator", "monitor", *graph.graph.nodes}
    caller = Caller(graph.tap, np.random.default_rng(0))
    expected = {"/pause", "/reset", "/step", *(f"/{node}/set_parameters" for node in nodes)}
    graph.spin_until(lambda: caller.meet() or expected <= set(caller.services))
    for _ in range(8):
        caller.act(4)
        # An answer is counted by a callback, which comes only after it.
        graph.spin_until(lambda: caller.answered == caller.sent)
    caller.call("/pause", SetBool.Request(data=False))
    assert graph.finish()[0].solved
    graph.spin_until(lambda: caller.answered == caller.sent)
    assert caller.answered == caller.sent
    for name in nodes:
        assert graph.graph.nodes.get(name, graph.monitor).counts["rejected messages"] >= 1, name


@pytest.fixture
def stranger():
    """A node of another participant, as of another process."""
    context = rclpy.Context()
    rclpy.init(context=context)
    yield rclpy.create_node("stranger", context=context)
    context.try_shutdown()


def test_a_stranger_on_a_topic_of_the_graph_is_named_also_with_a_foreign_type(play_graph, stranger):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    stranger.create_publisher(String, topics.POSE.name, 1)
    stranger.create_publisher(topics.TORQUE.type, topics.TORQUE.name, 1)
    expected = {(topics.POSE.name, "/stranger"), (topics.TORQUE.name, "/stranger")}
    graph.spin_until(lambda: graph.monitor.watch.seen == expected)
    assert graph.monitor.counts["foreign publishers"] >= 1
    assert graph.finish()[0].solved


def test_a_stranger_who_listens_to_the_ground_truth_is_named_and_nobody_else(play_graph, stranger):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    heard = graph.monitor.count_subscribers(topics.POSE.name)
    stranger.create_subscription(topics.POSE.type, topics.POSE.name, print, topics.POSE.qos)
    graph.spin_until(lambda: graph.monitor.count_subscribers(topics.POSE.name) > heard)
    graph.monitor.truth_watch.look()
    assert graph.monitor.truth_watch.seen == {"/tap"}, "neither oracles, which reports name, nor who hears what all may"
    stranger.create_subscription(topics.TRUE_EPISODE.type, topics.TRUE_EPISODE.name, print, topics.TRUE_EPISODE.qos)
    graph.spin_until(lambda: graph.monitor.truth_watch.seen == {"/tap", "/stranger"})
    assert graph.monitor.counts[OVERHEARD] == 2


def test_a_second_node_of_a_name_is_named_but_not_those_of_processes_that_were_killed(play_graph, stranger, capfd):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1), names=["simulator"])
    watch = graph.monitor.watch
    second = rclpy.create_node("simulator", context=stranger.context)
    second.create_publisher(topics.POSE.type, topics.POSE.name, topics.POSE.qos)
    watch.ghosts = lambda name: name == "simulator"
    graph.spin_until(lambda: graph.monitor.count_publishers(topics.POSE.name) == 2)
    watch.look()
    assert not watch.seen
    watch.ghosts = lambda name: 0
    graph.spin_until(lambda: watch.seen == {(topics.POSE.name, "/simulator")})
    assert "a second node /simulator publishes on /pose (of /simulator)" in capfd.readouterr().err


def test_who_has_no_name_yet_is_given_time_to_say_it(play_graph, monkeypatch):
    graph = play_graph(names=[])
    nobody = SimpleNamespace(node_namespace="_NODE_NAMESPACE_UNKNOWN_", node_name="_NODE_NAME_UNKNOWN_")
    monkeypatch.setattr(graph.monitor, "get_publishers_info_by_topic", lambda topic: [nobody])
    graph.monitor.watch.ghosts = lambda name: 1  # killed not long ago
    for _ in range(9):
        graph.monitor.watch.look()
    graph.monitor.watch.ghosts = lambda name: 0
    graph.monitor.watch.look()
    assert not graph.monitor.watch.seen
    graph.spin_until(lambda: graph.monitor.watch.seen)
    assert graph.monitor.counts["foreign publishers"] == 1


@pytest.fixture
def say_end(play_graph):
    """Return a graph without nodes that awaits seeds 0 and 1, and a function that says how one ends."""
    graph, topic = play_graph(episodes=Episodes(2, 0, difficulty=1), names=[]), topics.TRUE_EPISODE
    mouth = graph.tap.create_publisher(topic.type, topic.name, topic.qos)
    graph.spin_until(lambda: mouth.get_subscription_count() == 2)

    def say(seed, difficulty=1, *, tick=0, truncated=True):
        reading = conversions.EpisodeTruthReading(
            episode=seed + 1, seed=seed, difficulty=difficulty, level=generate_level(1, 0).to_text(), step=9, reward=0,
            episode_return=0.0, solved=False, terminated=False, truncated=truncated, boxes_on_target=1,
        )  # fmt: skip
        mouth.publish(conversions.episode_truth_to_msg(conversions.header((tick or seed + 1) * topics.TICK), reading))

    return graph, say


def test_an_end_that_is_heard_before_any_tick_ends_its_episode_alone(say_end):
    graph, say = say_end
    say(0)
    say(1)
    graph.spin_until(lambda: graph.monitor.results)
    assert graph.monitor.results[0].steps == 9 and not graph.monitor.results[0].solved


def test_the_last_end_counts_when_nothing_more_is_heard_though_no_tick_was_answered_or_a_stranger_denies_it(say_end):
    graph, say = say_end
    say(0, tick=3)
    say(0, tick=2, truncated=False)  # who says so does not go on
    say(1, tick=5)
    assert [result.seed for result in graph.finish()] == [0, 1]
    assert graph.monitor.counts["contradictory episodes"] == 1


def _say_tick(monitor, tick):
    """Have the monitor hear what the modules of a graph say in a tick."""
    stamp, state = tick * topics.TICK, np.zeros((10, 10, 4), np.float32)
    header, beta = conversions.header(stamp), conversions.termination_value(1, 0.0, terminated=False)
    for topic, message in (
        (topics.INSTRUCTION, conversions.instruction_to_msg(header, conversions.InstructionReading(1, 1))),
        (topics.TERMINATION, conversions.termination_to_msg(header, beta)),
        (topics.ABSTRACT_STATE, conversions.abstract_state_to_msg(header, state)),
        (topics.TRUE_ABSTRACT_STATE, conversions.abstract_state_to_msg(header, state)),
    ):
        monitor._receive(topic.name, Received(stamp, DECODERS[topic](message), serialize_message(message)))


def test_an_end_that_was_denied_is_forgotten_when_the_episode_goes_on_and_pauses(say_end, monkeypatch):
    graph, say = say_end
    say(0, tick=3)
    say(0, tick=40, truncated=False)
    graph.spin_until(lambda: graph.monitor.counts["contradictory episodes"] == 1)
    for tick in range(30, 41):
        _say_tick(graph.monitor, tick)
    monkeypatch.setattr("bringup.monitor._PATIENCE", 0.1)
    silent = time.monotonic()
    graph.spin_until(lambda: time.monotonic() - silent > 1.5)  # three times as long as between two looks
    assert not graph.monitor.results
    say(0, tick=41)
    say(1, tick=50)
    assert [result.seed for result in graph.finish()] == [0, 1]


@pytest.mark.parametrize(("seed", "difficulty"), [(77, 1), (0, 2)])
def test_an_episode_of_another_run_is_no_result_of_this_one(say_end, seed, difficulty, capfd):
    graph, say = say_end
    say(seed, difficulty)
    graph.spin_until(lambda: graph.monitor.counts[ANOTHER_RUN] == 1)
    assert graph.monitor.episode is None and not graph.monitor.results
    assert f"it plays seed {seed} at difficulty {difficulty}" in capfd.readouterr().err


def test_an_end_that_the_simulator_did_not_announce_is_taken_back_when_the_tick_is_offered_again(play_graph):
    graph = play_graph(names=["planner"])
    tap, header = graph.tap, conversions.header(3 * topics.TICK)
    mouths = {
        t: tap.create_publisher(t.type, t.name, t.qos)
        for t in (topics.EPISODE, topics.ABSTRACT_STATE, topics.TERMINATION)
    }
    graph.spin_until(lambda: all(mouth.get_subscription_count() for mouth in mouths.values()))
    state = conversions.abstract_state_to_msg(header, np.zeros((10, 10, 4), np.float32))
    planner = graph.graph.nodes["planner"]

    def offer(*, ended):
        reading = conversions.EpisodeReading(1, 2, ended)
        mouths[topics.EPISODE].publish(conversions.episode_to_msg(header, reading))
        mouths[topics.ABSTRACT_STATE].publish(state)
        beta = conversions.termination_value(0, 0.0, terminated=False)
        mouths[topics.TERMINATION].publish(conversions.termination_to_msg(header, beta))

    offer(ended=True)
    graph.spin_until(lambda: planner._handled == 3 * topics.TICK)
    assert not graph.said.instruction
    offer(ended=False)
    graph.spin_until(lambda: graph.said.instruction)
    assert planner.counts["contradictory episodes"] == 1


def test_messages_that_are_no_messages_are_named_by_topic(play_graph, capfd):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    publisher = graph.tap.create_publisher(topics.INSTRUCTION.type, topics.INSTRUCTION.name, topics.INSTRUCTION.qos)
    listeners = 5  # simulator, termination, controller, monitor and the test's tap
    graph.spin_until(lambda: graph.simulator.ticks >= 2 and publisher.get_subscription_count() == listeners)
    nobody = conversions.instruction_to_msg(
        conversions.header(max(graph.said.instruction)), conversions.InstructionReading(1, 1)
    )
    nobody.direction = 9
    publisher.publish(nobody)
    publisher.publish(b"\x00\x01\x00\x00short")
    graph.spin_until(lambda: graph.monitor.counts["rejected messages"] == 2)
    assert graph.finish()[0].solved
    assert "rejected a message on /instruction: direction must be one of 0 (STAY)" in capfd.readouterr().err


def test_a_tick_from_far_ahead_does_not_keep_those_of_the_run_from_being_counted(play_graph):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    graph.spin_until(lambda: graph.monitor.ticks >= 2)
    _say_tick(graph.monitor, 10**15 // topics.TICK)
    ticks = graph.monitor.ticks
    graph.spin_until(lambda: graph.monitor.ticks > ticks + 3)
    assert graph.finish()[0].solved


def test_a_flood_of_instructions_does_not_wash_away_the_one_that_is_waited_for(play_graph):
    graph = play_graph(names=["termination"])
    termination = graph.graph.nodes["termination"]
    termination._handled = 3 * topics.TICK
    for stamp in (3, *range(10, 200)):
        termination._on_instruction(Received(stamp * topics.TICK, conversions.InstructionReading(1, 2), b""))
    assert termination._previous(4 * topics.TICK) == conversions.InstructionReading(1, 2)
    assert 3 * topics.TICK in termination._said and len(termination._said) < 100


def test_every_topic_is_attacked():
    assert {topic.name for topic in TARGETS} == {*topics.GRAPH_TOPICS, topics.RECORDED.name, topics.MONITORED.name}


def test_what_is_wrong_again_and_again_is_counted_each_time_and_said_seldom_without_asking_who_calls(
    play_graph, capfd, monkeypatch
):
    node = play_graph(episodes=Episodes(1, 0, difficulty=1)).monitor
    reject(node, "/nowhere", "one")
    monkeypatch.setattr(rcutils_logger, "CallerId", lambda: pytest.fail("it looks for its caller on disk"))
    for _ in range(100):
        reject(node, "/nowhere", "two")
    assert node.counts["rejected messages"] == 101
    (said,) = (line for line in capfd.readouterr().err.splitlines() if "/nowhere" in line)
    assert said.endswith("a message on /nowhere: one")
