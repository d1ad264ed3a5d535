"""What is said too late, or of another episode: in real time answers may come after what they answer is over."""

import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from bringup.command import Stack
from mujoban_core.bodies import BALL
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.topics import TICK
from mujoban_sokoban.episodes import Episodes

BY_HAND = {"realtime": 4.0, "hold_limit": 10, "resend_after": 1000.0}
"""Settings of a simulator whose clock goes on without answers, step by step while it is paused."""
NOWHERE = 10**15
"""Stamp of no tick that is ever reached [ns]."""


class Modules(GraphNode):
    """Says what a test has it say in the place of all four modules; notes the number of the instruction in force."""

    def __init__(self):
        super().__init__("modules")
        self.numbers = {}
        for topic in (topics.EPISODE, topics.CAMERA, topics.PROPRIO, topics.POSE):
            self.create_subscription(topic.type, topic.name, lambda _: None, topic.qos)
        true = topics.TRUE_TERMINATION
        self.create_subscription(true.type, true.name, self._note, true.qos)
        self._said = {topic: self.create_publisher(topic.type, topic.name, topic.qos) for topic in topics.MODULE_TOPICS}

    def _note(self, message):
        self.numbers[conversions.stamp_of(message)] = message.sequence

    def say(self, stamp, number, effort=(0.0, 0.0)):
        """Answer a tick with a torque and an instruction to go east."""
        header = conversions.header(stamp)
        for topic, message in {
            topics.ABSTRACT_STATE: conversions.abstract_state_to_msg(header, np.zeros((10, 10, 4), np.float32)),
            topics.TERMINATION: conversions.termination_to_msg(header, conversions.termination_value(0, 0.0, False)),
            topics.TORQUE: JointState(header=header, effort=effort),
            topics.INSTRUCTION: conversions.instruction_to_msg(header, conversions.InstructionReading(number, 2)),
        }.items():
            self._said[topic].publish(message)

    def await_heard(self, graph):
        """Wait until the simulator has heard all that was said: also an answer to no tick, which it counts."""
        unknown = "messages of an unknown episode"
        due = graph.simulator.counts[unknown] + 2
        self.say(NOWHERE, 1)
        graph.spin_until(lambda: graph.simulator.counts[unknown] == due)

    def start(self, graph):
        """Hold the world at its first tick, and answer that."""
        assert graph.call(SetBool, "/pause", SetBool.Request(data=True)).success
        graph.spin_until(lambda: graph.monitor.stamp == TICK)
        self.say(TICK, 1)
        graph.spin_until(lambda: graph.simulator.pace.running)

    def step(self, graph):
        """Advance the world by a tick, whether or not the one before was answered."""
        due = graph.monitor.stamp + TICK
        assert graph.call(Trigger, "/step", Trigger.Request()).success
        graph.spin_until(lambda: graph.monitor.stamp == due and due in self.numbers)


def test_answers_that_come_after_an_episodes_end_are_not_taken_for_those_of_the_next(play_graph):
    graph = play_graph(names=["simulator"], episodes=Episodes(2, 47, difficulty=2), time_limit=4, **BY_HAND)
    modules = graph.graph.add(Modules())
    modules.start(graph)
    for _ in range(4):
        late = graph.monitor.stamp
        modules.step(graph)
    assert graph.monitor.episode.truncated
    modules.step(graph)
    assert (graph.monitor.episode.episode, graph.simulator.ticks) == (2, 4)
    modules.say(late, 37, effort=[1.0, -1.0])
    modules.await_heard(graph)
    for _ in range(3):
        modules.step(graph)
        assert modules.numbers[graph.monitor.stamp] == 0, "no instruction is in force"
    assert np.abs(graph.simulator.world.velocity).max() < 0.05
    modules.say(graph.monitor.stamp, 1)
    modules.await_heard(graph)
    modules.step(graph)
    assert [result.instructions for result in graph.finish()] == [1, 1]


def test_in_real_time_the_newest_of_late_instructions_is_in_force(play_graph):
    graph = play_graph(names=["simulator"], **BY_HAND)
    modules = graph.graph.add(Modules())
    modules.start(graph)
    for _ in range(3):
        modules.step(graph)
    late = graph.monitor.stamp - 2 * TICK
    for said in (((late, 5), (late + TICK, 6), (late, 5)), ((late, 5),)):
        for stamp, number in said:
            modules.say(stamp, number)
        modules.await_heard(graph)
        modules.step(graph)
        assert modules.numbers[graph.monitor.stamp] == 6


def test_what_was_said_to_a_robot_before_its_episode_began_is_forgotten(play_graph, fresh_weights):
    graph = play_graph(Stack(fresh_weights.choices), names=["termination"])
    inputs = (topics.EPISODE, topics.CAMERA, topics.PROPRIO, topics.INSTRUCTION)
    publishers = {topic: graph.tap.create_publisher(topic.type, topic.name, topic.qos) for topic in inputs}
    answered, beta = {}, topics.TERMINATION
    graph.tap.create_subscription(
        beta.type, beta.name, lambda m: answered.update({conversions.stamp_of(m): m.sequence}), beta.qos
    )
    # The tap, the monitor and the node hear instructions.
    graph.spin_until(lambda: publishers[topics.INSTRUCTION].get_subscription_count() == 3)

    def instruct(tick, number):
        header, said = conversions.header(tick * TICK), conversions.InstructionReading(number, 2)
        publishers[topics.INSTRUCTION].publish(conversions.instruction_to_msg(header, said))
        graph.spin_until(lambda: graph.said.instruction.get(tick * TICK) == (number, 2))

    def offer(tick):
        header, episode = conversions.header(tick * TICK), conversions.EpisodeReading(1, tick - 1, False)
        publishers[topics.EPISODE].publish(conversions.episode_to_msg(header, episode))
        publishers[topics.CAMERA].publish(conversions.frame_to_msg(header, np.zeros((64, 64, 3), np.uint8)))
        publishers[topics.PROPRIO].publish(conversions.proprio_to_msg(header, np.zeros(BALL.proprio_size), BALL.joints))

    instruct(1, 37)
    offer(1)
    graph.spin_until(lambda: TICK in answered)
    offer(2)
    instruct(1, 5)
    graph.spin_until(lambda: 2 * TICK in answered)
    assert answered == {TICK: 0, 2 * TICK: 5}
