"""A second simulator comes into a graph and goes: the first one's run goes on without it."""

import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from bringup.graph_recorder import RecorderNode
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import open_bag
from mujoban_msgs_py.topics import TICK
from mujoban_sim.node import SimulatorNode
from mujoban_sokoban.episodes import Episodes


@pytest.fixture
def add_simulator():
    """Return a function that adds a simulator, with parameters, to a graph."""

    def add(graph, **parameters):
        values = {"difficulty": 1, "seed": 3, "resend_after": 0.1, **parameters}
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return graph.graph.add(SimulatorNode(parameter_overrides=overrides, intra_process=graph.graph.intra_process))

    return add


def goes_on_after(graph, add_simulator, ticks=0, beyond=None):
    """Pause, let another simulator play so many ticks, or so many more than this one, end it, and go on."""
    graph.call(SetBool, "/pause", SetBool.Request(data=True))
    held = graph.simulator.ticks
    second = add_simulator(graph)
    graph.spin_until(lambda: second.ticks >= (ticks if beyond is None else held + beyond))
    graph.graph.end(second)
    graph.call(SetBool, "/pause", SetBool.Request(data=False))
    graph.spin_until(lambda: graph.simulator.ticks >= held + 10)
    assert graph.simulator.counts["repeated ticks"] < 30, "a module waits for what was said to the other one"


def test_a_simulator_whose_time_another_was_ahead_of_goes_on_in_mid_episode(play_graph, add_simulator):
    graph = play_graph(episodes=Episodes(1, 5, difficulty=2), resend_after=0.1)
    graph.spin_until(lambda: graph.simulator.ticks >= 10)
    goes_on_after(graph, add_simulator, beyond=10)


def test_a_simulator_does_not_stall_for_what_another_made_the_modules_forget(play_graph, add_simulator):
    graph = play_graph(episodes=Episodes(1, 5, difficulty=2), resend_after=0.1)
    graph.spin_until(lambda: graph.simulator.ticks >= 30)
    goes_on_after(graph, add_simulator, ticks=3)


def test_a_second_simulator_is_recorded_into_another_file_and_no_tick_is_confirmed_that_is_not(
    play_graph, add_simulator, tmp_path
):
    graph = play_graph(episodes=Episodes(1, 5, difficulty=2), intra_process=False, await_recorder=True)
    path = Parameter("path", value=str(tmp_path / "bag"))
    recorder = graph.graph.add(RecorderNode(parameter_overrides=[path]))
    graph.spin_until(lambda: recorder.written >= 30 * TICK)
    graph.graph.stop("simulator")
    before = recorder.written
    second = add_simulator(graph, time_limit=12, await_recorder=True)
    graph.spin_until(second.finished.done)
    graph.graph.end(recorder)
    bag = open_bag(tmp_path / "bag")
    played = [(value.value.seed, value.value.step) for value in bag.read([topics.TRUE_EPISODE.name])]
    assert played == [(5, step) for step in range(before // TICK)] + [(3, step) for step in range(13)]
    assert len(bag.files) == 2 and bag.topics[topics.TORQUE.name].count == before // TICK + 12
