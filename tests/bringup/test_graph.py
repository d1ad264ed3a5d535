"""What the graph bears: nodes that die, services, bad input, a clock that does not wait."""

import errno
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from safetensors.numpy import save
from sensor_msgs.msg import Image, JointState
from std_srvs.srv import SetBool, Trigger

from bringup.command import Choice, Stack
from bringup.graph import NODES, GraphError, InProcess, Processes
from bringup.monitor import MonitorNode
from bringup.parameters import graph_parameters
from mujoban_core.bodies import ANT
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.listening import ANOTHER_RUN
from mujoban_msgs_py.run_identifier import run_of
from mujoban_msgs_py.runtime import diagnostics
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.topics import TICK
from mujoban_sokoban.episodes import Episodes

MODULES = ("estimator", "termination", "planner", "controller")


@pytest.mark.parametrize("name", MODULES)
def test_an_episode_ends_though_a_module_is_killed_and_started_again(play_graph, name):
    graph = play_graph()
    graph.spin_until(lambda: graph.simulator.ticks >= 30)
    graph.graph.stop(name)
    ticks = graph.simulator.ticks
    graph.spin_until(lambda: graph.simulator.counts["repeated ticks"] >= 1)
    assert graph.simulator.ticks <= ticks + 1, "the world has gone on without an answer"
    graph.graph.start(name)
    (result,) = graph.finish()
    assert result.solved


def test_an_episode_ends_though_all_modules_are_killed_and_started_again(play_graph):
    graph = play_graph()
    graph.spin_until(lambda: graph.simulator.ticks >= 30)
    for name in MODULES:
        graph.graph.stop(name)
    for name in MODULES:
        graph.graph.start(name)
    (result,) = graph.finish()
    assert result.solved


def test_a_simulator_that_is_killed_goes_on_at_the_same_tick_as_if_nothing_had_happened(play_graph, tmp_path):
    episodes = Episodes(2, 0, difficulty=1)
    undisturbed = play_graph(episodes=episodes)
    expected = undisturbed.finish()
    undisturbed.__exit__(None, None, None)
    graph = play_graph(episodes=episodes, resume_file=str(tmp_path / "moment.safetensors"))
    for ticks in (10, len(undisturbed.said.torque) - 5):
        graph.spin_until(lambda ticks=ticks: len(graph.said.torque) >= ticks)
        graph.graph.stop("simulator")
        graph.graph.start("simulator")
    assert graph.finish() == expected
    assert graph.said.torque == undisturbed.said.torque and graph.said.reward == undisturbed.said.reward
    assert [e.episode for e in graph.said.episodes.values()] == [e.episode for e in undisturbed.said.episodes.values()]


def test_a_simulator_that_is_killed_at_an_episodes_last_tick_begins_the_next_one(play_graph, tmp_path):
    graph = play_graph(episodes=Episodes(2, 0, difficulty=1), time_limit=6, resume_file=str(tmp_path / "moment"))
    graph.spin_until(lambda: graph.simulator.ticks >= 2)
    assert graph.call(SetBool, "/pause", SetBool.Request(data=True)).success
    while not graph.simulator.world.done[0]:
        ticks = graph.simulator.ticks
        assert graph.call(Trigger, "/step", Trigger.Request()).success
        graph.spin_until(lambda ticks=ticks: graph.simulator.ticks > ticks)
    graph.graph.stop("simulator")
    graph.graph.start("simulator")
    assert [result.seed for result in graph.finish()] == [0, 1]


def test_in_lockstep_no_tick_passes_that_an_awaited_monitor_has_not_heard(play_graph):
    episodes = Episodes(1, 0, difficulty=1)
    graph = play_graph(episodes=episodes, await_monitor=True)
    graph.spin_until(lambda: graph.monitor.ticks >= 10)
    graph.graph.end(graph.monitor)
    before = graph.monitor.ticks
    graph.spin_until(lambda: graph.simulator.counts["repeated ticks"] >= 2)
    assert graph.simulator.ticks <= before, "the world has gone on unheard"
    monitor = graph.graph.add(MonitorNode(episodes))
    graph.spin_until(monitor.finished.done)
    assert monitor.results[0].solved and before + monitor.ticks >= graph.simulator.ticks


def test_in_real_time_the_clock_starts_when_the_awaited_monitor_has_heard_the_first_tick(play_graph):
    episodes = Episodes(1, 0, difficulty=1)
    graph = play_graph(names=(), episodes=episodes, await_monitor=True, realtime=20.0)
    graph.graph.end(graph.monitor)
    for name in NODES:
        graph.graph.start(name)
    graph.tap.create_publisher(topics.MONITORED.type, topics.MONITORED.name, topics.MONITORED.qos)  # and says nothing
    graph.spin_until(lambda: graph.simulator.counts["repeated ticks"] >= 2)
    assert graph.simulator.ticks == 0
    monitor = graph.graph.add(MonitorNode(episodes))
    graph.spin_until(monitor.finished.done)
    assert monitor.results[0].solved and 0 in {e.step for e in graph.said.episodes.values()}


def test_modules_that_are_killed_go_on_from_what_they_remember_as_if_nothing_had_happened(
    play_graph, fresh_weights, tmp_path, capfd
):
    stack = Stack(fresh_weights.choices | {"planner": Choice("planner")}, look_around=5)
    episodes = Episodes(2, 5, difficulty=3)
    undisturbed = play_graph(stack, episodes, time_limit=40)
    expected = undisturbed.finish()
    undisturbed.__exit__(None, None, None)
    graph = play_graph(stack, episodes, time_limit=40, memories=tmp_path)
    for ticks, names in ((4, MODULES[:1]), (16, MODULES[1:2]), (24, MODULES[2:3]), (32, MODULES[3:]), (60, MODULES)):
        graph.spin_until(lambda ticks=ticks: len(graph.said.torque) >= ticks)
        for name in names:
            graph.graph.stop(name)
        for name in names:
            graph.graph.start(name)
    assert graph.finish() == expected
    assert "jumped back" not in capfd.readouterr().err, "what was said before the kill is taken for another run"
    assert graph.said.estimate == undisturbed.said.estimate
    assert graph.said.instruction == undisturbed.said.instruction
    assert graph.said.torque == undisturbed.said.torque


def test_a_node_whose_disk_is_full_works_on_without_a_memory_to_go_on_from(play_graph, tmp_path, monkeypatch):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1), memories=tmp_path)
    graph.spin_until(lambda: graph.simulator.ticks >= 5)
    assert {file.stem for file in tmp_path.iterdir()} == set(NODES)

    def full(self, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    (result,) = graph.finish()
    assert result.solved and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["simulator", "termination"])
@pytest.mark.parametrize("data", [b"nothing", save({"place": np.zeros(2, np.int64), "answer": np.zeros(0, np.uint8)})])
def test_a_file_that_a_node_has_not_kept_is_named(play_graph, tmp_path, name, data):
    (tmp_path / f"{name}.safetensors").write_bytes(data)
    with pytest.raises(ValueError, match=rf"{name}\.safetensors: expected what this node has kept: "):
        play_graph(memories=tmp_path, names=[name])


def test_every_node_says_on_diagnostics_how_it_is(play_graph):
    graph = play_graph(episodes=Episodes(99, 47, difficulty=2), time_limit=4000)
    heard = {}
    graph.tap.create_subscription(
        DiagnosticArray, "/diagnostics", lambda message: heard.update({s.name: s for s in message.status}), 10
    )
    shown = {"/simulator": "running", "/planner": "answering (privileged)"}
    graph.spin_until(lambda: len(heard) == len(NODES) and all(heard[n].message == said for n, said in shown.items()))
    assert set(heard) == {f"/{name}" for name in NODES}
    planner = {value.key: value.value for value in heard["/planner"].values}
    assert "dropped messages" in planner and planner["module"] == "oracle (privileged)"


def test_who_begins_to_listen_is_told_at_once_how_each_node_is(play_graph, monkeypatch):
    monkeypatch.setattr(diagnostics, "PERIOD", 1000.0)
    graph, heard = play_graph(), []
    for _ in range(2):
        names = set()
        graph.tap.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m, names=names: names.update(s.name for s in m.status), 10
        )
        heard.append(names)
        graph.spin_until(lambda names=names: len(names) == len(NODES))
    assert heard == 2 * [{f"/{name}" for name in NODES}]


def test_processes_that_are_killed_are_started_again(ros, oracles):
    episodes = Episodes(1, 47, difficulty=2)
    parameters = graph_parameters(oracles, episodes)
    with InProcess(parameters, ()) as graph, Processes(parameters) as processes:
        monitor = graph.add(MonitorNode(episodes))
        monitor.create_timer(0.1, processes.supervise)

        def spin_until(condition):
            deadline = time.monotonic() + 100
            while not condition():
                assert time.monotonic() < deadline, "the graph stands still"
                graph.executor.spin_once(timeout_sec=0.05)

        spin_until(lambda: monitor.ticks >= 20)
        processes.kill("controller", signal.SIGKILL)
        processes.kill("simulator", signal.SIGKILL)
        spin_until(monitor.finished.done)
        assert processes.restarts == {"controller": 1, "simulator": 1}
        assert monitor.results[0].solved and monitor.results[0].seed == 47


@pytest.mark.parametrize(
    ("role", "misfit", "said"),
    [
        ("estimator", "FlatEstimator", r"the estimator gives .* of shape \(1, 3\): expected \(1, 10, 10, 4\)"),
        ("termination", "DoubtfulTermination", r"the termination gives .* of shape \(1, 3\): expected \(1,\)"),
        ("planner", "CarelessPlanner", "decide of the planner returns ndarray: expected two"),
        ("controller", "ManyHandedController", r"torques of shape \(1, 5\): expected \(1, 2\)"),
    ],
)
def test_a_module_that_answers_by_another_shape_ends_the_graph_and_is_named(play_graph, oracles, role, misfit, said):
    graph = play_graph(Stack(oracles.choices | {role: Choice(role, f"misfits:{misfit}")}))
    with pytest.raises(ValueError, match=said):
        graph.finish()


def test_a_node_that_cannot_finish_its_file_keeps_no_other_from_it(ros, oracles):
    class FullDisk(GraphNode):
        def destroy_node(self):
            super().destroy_node()
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="disk"), InProcess(graph_parameters(oracles, Episodes(1, 47)), ()) as graph:
        bag, film = graph.add(FullDisk("bag")), graph.add(GraphNode("film"))
    assert bag.ended and film.ended


def test_a_process_that_answers_no_tick_is_given_up_after_a_few_starts(ros, oracles, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "importable"))
    episodes = Episodes(1, 47, difficulty=2)
    stack = Stack(oracles.choices | {"controller": Choice("controller", "misfits:FailingController")})
    parameters = graph_parameters(stack, episodes)
    with InProcess(parameters, ()) as graph, Processes(parameters) as processes:
        monitor = graph.add(MonitorNode(episodes))
        said = r"the controller node has ended 3 times without an answer to a tick, with status 1 at last: .*no legs"
        deadline = time.monotonic() + 100
        with pytest.raises(GraphError, match=said):
            while time.monotonic() < deadline:
                processes.supervise(begun=monitor.ticks > 0)
                graph.executor.spin_once(timeout_sec=0.05)
        assert processes.restarts == {"controller": 2}


def test_pause_holds_the_world_and_step_advances_it_by_one_tick(play_graph):
    graph = play_graph()
    graph.spin_until(lambda: graph.simulator.ticks >= 5)
    assert graph.call(SetBool, "/pause", SetBool.Request(data=True)).success
    held = graph.simulator.ticks
    for _ in range(3):
        assert graph.call(Trigger, "/step", Trigger.Request()).success
        held += 1
        graph.spin_until(lambda expected=held: graph.simulator.ticks == expected)
    time.sleep(0.1)
    graph.graph.executor.spin_once(timeout_sec=0.1)
    assert graph.simulator.ticks == held
    assert graph.call(SetBool, "/pause", SetBool.Request(data=False)).success
    assert not graph.call(Trigger, "/step", Trigger.Request()).success
    assert graph.finish()[0].solved


def test_reset_starts_the_same_episode_again(play_graph):
    graph = play_graph()
    graph.spin_until(lambda: graph.simulator.ticks >= 20)
    assert graph.call(Trigger, "/reset", Trigger.Request()).success
    (result,) = graph.finish()
    assert result.solved and result.seed == 47 and graph.simulator.counts["resets"] == 1
    episodes = graph.said.episodes.values()
    assert [e.episode for e in episodes if e.step == 0] == [1, 2]
    assert len({(e.seed, e.level) for e in episodes}) == 1


def test_an_episode_that_has_ended_is_not_reset_but_followed_by_the_next(play_graph):
    graph = play_graph(episodes=Episodes(2, 47, difficulty=2), time_limit=30)
    assert graph.call(SetBool, "/pause", SetBool.Request(data=True)).success
    while not graph.simulator.world.done[0]:
        due = graph.simulator.ticks + 1
        graph.call(Trigger, "/step", Trigger.Request())
        graph.spin_until(lambda due=due: graph.simulator.ticks == due)
    refused = graph.call(Trigger, "/reset", Trigger.Request())
    assert not refused.success and "the next one follows" in refused.message
    assert graph.call(SetBool, "/pause", SetBool.Request(data=False)).success
    assert [result.seed for result in graph.finish()] == [47, 48]


@pytest.mark.parametrize("role", ["termination", "controller"])
def test_the_proprioception_of_another_body_is_rejected_and_ends_no_node(play_graph, fresh_weights, role):
    graph = play_graph(Stack(fresh_weights.choices), Episodes(1, 0, difficulty=1), time_limit=100)
    publisher = graph.tap.create_publisher(topics.PROPRIO.type, topics.PROPRIO.name, topics.PROPRIO.qos)
    node = graph.graph.nodes[role]
    graph.spin_until(lambda: graph.simulator.ticks >= 2)
    stamp = graph.monitor.stamp + 6 * TICK
    publisher.publish(conversions.proprio_to_msg(conversions.header(stamp), np.zeros(ANT.proprio_size), ANT.joints))
    graph.spin_until(lambda: node.counts["rejected messages"] == 1)
    assert graph.finish()[0].steps == 100


@pytest.mark.parametrize("effort", [[float("nan"), 0.0], [0.0, 1.5], [0.0]])
def test_a_bad_torque_is_rejected_counted_and_zero_is_held(play_graph, effort):
    graph = play_graph(names=[name for name in NODES if name != "controller"])
    publisher = graph.tap.create_publisher(JointState, topics.TORQUE.name, topics.TORQUE.qos)
    graph.spin_until(lambda: graph.said.instruction)
    (stamp,) = graph.said.instruction
    publisher.publish(JointState(header=conversions.header(stamp), effort=effort))
    graph.spin_until(lambda: graph.simulator.ticks == 1)
    assert graph.simulator.counts["rejected torques"] == 1
    assert np.abs(graph.simulator.world.velocity).max() < 0.05


@pytest.mark.parametrize("choices", [{}, {"controller": Choice("controller")}])
def test_torques_name_the_joints_and_the_frame_that_they_are_of(play_graph, oracles, choices):
    graph, heard = play_graph(Stack(oracles.choices | choices)), []
    graph.tap.create_subscription(JointState, topics.TORQUE.name, heard.append, topics.TORQUE.qos)
    graph.spin_until(lambda: heard)
    assert (heard[0].header.frame_id, heard[0].name) == ("base_link", ["roll", "steer"])


def test_a_torque_of_an_unknown_episode_is_counted_and_changes_nothing(play_graph):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    publisher = graph.tap.create_publisher(JointState, topics.TORQUE.name, topics.TORQUE.qos)
    graph.spin_until(lambda: graph.simulator.ticks >= 2)
    for stamp in (TICK // 2, 0, 10**15):
        publisher.publish(JointState(header=conversions.header(stamp), effort=[1.0, 1.0]))
    graph.spin_until(lambda: graph.simulator.counts["messages of an unknown episode"] == 2)
    assert graph.simulator.counts[ANOTHER_RUN] == 1
    assert graph.finish()[0].solved


def test_two_runs_in_one_domain_leave_each_other_alone(play_graph, fresh_weights, capfd):
    stack = Stack(fresh_weights.choices | {"planner": Choice("planner")}, look_around=5)
    runs = {7: Episodes(1, 5, difficulty=3), TICK - 1: Episodes(1, 6, difficulty=3)}
    alone = {}
    for run, episodes in runs.items():
        graph = play_graph(stack, episodes, time_limit=30, run=run)
        alone[run] = graph.finish(), graph.said.estimate
        graph.__exit__(None, None, None)
    graphs = {run: play_graph(stack, episodes, time_limit=30, run=run) for run, episodes in runs.items()}
    deadline = time.monotonic() + 60.0
    while not all(graph.monitor.finished.done() for graph in graphs.values()):
        assert time.monotonic() < deadline, "the graphs stand still"
        for graph in graphs.values():
            graph.graph.executor.spin_once(timeout_sec=0.01)
    for run, graph in graphs.items():
        estimates = {stamp: raw for stamp, raw in graph.said.estimate.items() if run_of(stamp) == run}
        assert (graph.monitor.results, estimates) == alone[run]
        for node in (graph.monitor, *graph.graph.nodes.values()):
            assert node.counts[ANOTHER_RUN] > 0, f"{node.get_name()} has not noticed the other run"
    assert re.search("another run is in this ROS domain: /[a-z_/]+ has messages of run 7", capfd.readouterr().err)


def test_an_image_of_wrong_size_or_encoding_is_rejected_and_counted(play_graph):
    graph = play_graph(episodes=Episodes(1, 0, difficulty=1))
    publisher = graph.tap.create_publisher(Image, topics.CAMERA.name, topics.CAMERA.qos)
    estimator = graph.graph.nodes["estimator"]
    graph.spin_until(lambda: graph.simulator.ticks >= 2)
    header = conversions.header(10**12)
    good = conversions.frame_to_msg(header, np.zeros((64, 64, 3), np.uint8))
    good.encoding = "bgr8"
    publisher.publish(good)
    publisher.publish(conversions.frame_to_msg(header, np.zeros((32, 64, 3), np.uint8)))
    graph.spin_until(lambda: estimator.counts["rejected messages"] == 2)
    assert graph.finish()[0].solved


def test_messages_without_an_episode_are_left_alone(play_graph):
    graph = play_graph(names=["estimator"])
    publisher = graph.tap.create_publisher(PoseStamped, topics.POSE.name, topics.POSE.qos)
    graph.spin_until(publisher.get_subscription_count)
    for tick in range(1, 100):
        publisher.publish(conversions.pose_to_msg(conversions.header(tick * TICK), (0.0, 0.0, 0.0)))
    estimator = graph.graph.nodes["estimator"]
    graph.spin_until(lambda: estimator.dropped[topics.POSE.name] >= 50)


def test_in_real_time_the_latest_torque_is_held_for_a_few_ticks_until_the_clock_waits(play_graph):
    # Silence of `resend_after` stops the clock as well, and ten ticks on a busy machine may take longer than 0.2 s.
    options = {"realtime": 4.0, "time_limit": 200, "hold_limit": 10, "resend_after": 1.0}
    graph = play_graph(names=[n for n in NODES if n != "controller"], **options)
    simulator = graph.simulator
    publisher = graph.tap.create_publisher(JointState, topics.TORQUE.name, topics.TORQUE.qos)

    def answer():
        publisher.publish(JointState(header=conversions.header(max(graph.said.instruction)), effort=[0.0, 0.5]))

    graph.spin_until(lambda: graph.said.instruction)
    answer()
    graph.spin_until(lambda: simulator.counts["repeated ticks"] >= 2 and simulator.counts["waits of the clock"])
    assert simulator.ticks == 11 and simulator.counts["late answers"] == 10, "the robot drives on without a driver"
    assert abs(simulator.world.velocity[0, 2]) > 0.5
    assert simulator.counts["waits of the clock"] == 1
    graph.spin_until(lambda: simulator.counts["repeated ticks"] >= 4)
    assert simulator.ticks == 11
    answer()
    graph.spin_until(lambda: simulator.ticks > 11)


def test_real_time_keeps_to_the_clock(play_graph):
    graph = play_graph(episodes=Episodes(1, 47, difficulty=2), realtime=2.0, time_limit=80)
    graph.spin_until(lambda: graph.simulator.ticks >= 1)
    start, ticks = time.monotonic(), graph.simulator.ticks
    graph.finish()
    seconds = (graph.simulator.ticks - ticks) * TICK * 1e-9 / 2.0
    assert time.monotonic() - start >= 0.9 * seconds


def test_real_time_that_is_kept_is_not_complained_of_when_the_clock_starts(play_graph, capfd):
    play_graph(realtime=0.25, time_limit=2).finish()
    assert "not kept" not in capfd.readouterr().err
