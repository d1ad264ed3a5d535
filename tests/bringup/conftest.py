"""A graph to play with: all nodes on one executor, and a tap that notes what the modules say."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from bringup.command import Choice, Stack
from bringup.graph import NODES, InProcess, keep_memories
from bringup.monitor import MonitorNode
from bringup.parameters import graph_parameters
from mujoban_core.plugins import ROLES
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import EpisodeTruthReading
from mujoban_msgs_py.listening import listen
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_sokoban.episodes import Episodes

ORACLES = Stack({role: Choice(role, "oracle") for role in ROLES})


@dataclass
class Said:
    """What was said, by stamp."""

    estimate: dict[int, bytes] = field(default_factory=dict)
    instruction: dict[int, tuple[int, int]] = field(default_factory=dict)
    torque: dict[int, list[float]] = field(default_factory=dict)
    reward: dict[int, float] = field(default_factory=dict)
    episodes: dict[int, EpisodeTruthReading] = field(default_factory=dict)


class Tap(GraphNode):
    """Notes estimates, instructions, torques and rewards."""

    def __init__(self, intra_process=None):
        super().__init__("tap", intra_process=intra_process)
        self.said = Said()
        qos = live_qos(1000)
        listen(self, topics.TRUE_EPISODE, self._episode, qos=qos)
        listen(self, topics.INSTRUCTION, self._instruction, qos=qos)
        listen(self, topics.ABSTRACT_STATE, self._estimate, qos=qos)
        listen(self, topics.TORQUE, self._torque, qos=qos)

    def _episode(self, message):
        self.said.episodes[message.stamp] = message.content
        self.said.reward[message.stamp] = message.content.reward

    def _instruction(self, message):
        self.said.instruction[message.stamp] = tuple(message.content)

    def _estimate(self, message):
        self.said.estimate[message.stamp] = message.content.tobytes()

    def _torque(self, message):
        self.said.torque[message.stamp] = message.content.tolist()


class Play:
    """A running graph."""

    def __init__(self, stack: Stack, episodes: Episodes, names=NODES, memories=None, intra_process=True, **simulator):
        simulator.setdefault("resend_after", 0.2)
        self.parameters = graph_parameters(stack, episodes, **simulator)
        if memories is not None:
            keep_memories(self.parameters, dict.fromkeys(self.parameters, memories))
        self.graph = InProcess(self.parameters, (), intra_process=intra_process)
        self._open = True
        self.tap = self.graph.add(Tap(self.graph.intra_process))
        run = self.parameters["simulator"]["run"]
        self.monitor = self.graph.add(MonitorNode(episodes, run=run, intra_process=self.graph.intra_process))
        for name in names:
            self.graph.start(name)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        if self._open:
            self._open = False
            self.graph.__exit__(*exception)

    @property
    def said(self) -> Said:
        return self.tap.said

    @property
    def simulator(self):
        return self.graph.nodes["simulator"]

    def spin_until(self, condition: Callable[[], object], timeout: float = 60.0):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, "the graph stands still"
            self.graph.executor.spin_once(timeout_sec=0.05)

    def finish(self):
        self.spin_until(self.monitor.finished.done)
        return self.monitor.results

    def call(self, service_type, name: str, request):
        client = self.tap.create_client(service_type, name)
        self.spin_until(client.service_is_ready)
        future = client.call_async(request)
        self.spin_until(future.done)
        self.tap.destroy_client(client)
        return future.result()


@pytest.fixture
def play_graph(ros):
    """Return a function that starts a graph; it is stopped after the test."""
    running = []

    def start(stack=ORACLES, episodes=None, **options):
        running.append(Play(stack, episodes or Episodes(1, 47, difficulty=2), **options))
        return running[-1]

    yield start
    for graph in running:
        graph.__exit__(None, None, None)


@pytest.fixture(scope="session")
def fresh_weights(tmp_path_factory):
    """Return a stack of untrained networks, saved as weights."""
    import torch

    from mujoban_controller.controller import VisuomotorController
    from mujoban_estimator.estimator import StateEstimator
    from mujoban_estimator.termination import ControlTermination
    from mujoban_rl.weights import save_weights

    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    modules = {"estimator": StateEstimator, "termination": ControlTermination, "controller": VisuomotorController}
    choices = {"planner": Choice("planner", "oracle")}
    for role, kind in modules.items():
        path = folder / f"{role}.safetensors"
        save_weights(path, kind(), {}, {})
        choices[role] = Choice(role, weights=path)
    return Stack({role: choices[role] for role in ROLES})


@pytest.fixture(scope="session")
def ant_teacher(tmp_path_factory):
    """Return weights of an untrained teacher of the ant."""
    import torch

    from mujoban_controller.privileged import PrivilegedPolicy
    from mujoban_rl.weights import save_weights

    torch.manual_seed(0)
    policy = PrivilegedPolicy("ant")
    path = tmp_path_factory.mktemp("ant") / "teacher.safetensors"
    save_weights(path, policy, policy.config, {})
    return path


@pytest.fixture(scope="session")
def oracles():
    """Return the stack of oracles."""
    return ORACLES
