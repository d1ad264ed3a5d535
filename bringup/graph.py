"""Start the nodes of the graph: all in this process on one executor, or each in a process of its own."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from bringup.parameters import Parameters, write_parameters
from mujoban_baselines.node import AgentNode
from mujoban_controller.node import ControllerNode
from mujoban_core import children
from mujoban_core.plugins import AGENT
from mujoban_core.program import USAGE_ERROR
from mujoban_estimator.node import EstimatorNode
from mujoban_estimator.termination_node import TerminationNode
from mujoban_msgs_py.listening import LEASE
from mujoban_msgs_py.runtime.intra_process import IntraProcess
from mujoban_msgs_py.runtime.module_node import ModuleNode
from mujoban_msgs_py.runtime.shared_memory import RunFolder, clear_shared_memory
from mujoban_planner.node import PlannerNode
from mujoban_sim.node import SimulatorNode

NodeT = TypeVar("NodeT", bound=Node)
GraphNode = SimulatorNode | ModuleNode
NODES: dict[str, type[GraphNode]] = {
    "simulator": SimulatorNode,
    "estimator": EstimatorNode,
    "termination": TerminationNode,
    "planner": PlannerNode,
    "controller": ControllerNode,
}
"""The nodes of the graph by name."""
ALONE: dict[str, type[GraphNode]] = {"simulator": SimulatorNode, AGENT: AgentNode}
"""Those of a graph in which an agent plays alone."""
_KINDS = NODES | ALONE

RESPAWN_PERIOD = 0.1
"""Seconds between two looks at whether the processes live."""
RESTART_LIMIT = 20
"""Times that a node is started again before the graph is given up."""
SILENT_LIMIT = 3
"""Times in a row that a node may end without an answer to a tick; a further start would end as these did."""


class GraphError(ValueError):
    """A node of the graph could not start; it has said why."""


def keep_memories(parameters: Parameters, folders: Mapping[str, Path]) -> None:
    """Have each node keep in its folder what it needs to go on from where it was, when it is started again."""
    for name, values in parameters.items():
        values["resume_file"] = str(_memory(folders[name], name))


def _memory(folder: Path, name: str) -> Path:
    return folder / f"{name}.safetensors"


class InProcess:
    """All nodes in this process on one executor.

    Attributes:
        executor: Runs the nodes.
        nodes: The nodes of the graph by name.
        intra_process: Hands over messages between nodes that are made with it; None: all go through the middleware.
    """

    def __init__(
        self,
        parameters: Parameters,
        names: Iterable[str] = NODES,
        *,
        intra_process: bool = True,
        context: Context | None = None,
    ) -> None:
        """Start the named nodes of the graph.

        Args:
            parameters: Of each node.
            names: Nodes to start.
            intra_process: Whether these nodes hand over messages while nobody else reads them.
            context: The ROS context, if not the default one.

        Raises:
            ValueError: If a module or what a parameter names is bad.
        """
        self.executor = EventsExecutor(context=context)
        self.intra_process = IntraProcess() if intra_process else None
        self.nodes: dict[str, GraphNode] = {}
        self._parameters = parameters
        self._context = context
        self._others: list[Node] = []
        with ExitStack() as undo:
            undo.push(self)
            for name in names:
                self.start(name)
            undo.pop_all()

    def __enter__(self) -> InProcess:
        """Return this graph."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Stop all nodes, also where one of them fails: each may have a file to finish."""
        with ExitStack() as ends:
            ends.callback(self.executor.shutdown)
            for node in reversed((*self._others, *self.nodes.values())):
                ends.callback(self._remove, node)

    def start(self, name: str) -> None:
        """Start a node of the graph."""
        overrides = [Parameter(key, value=value) for key, value in self._parameters[name].items()]
        self.nodes[name] = _KINDS[name](
            parameter_overrides=overrides, context=self._context, intra_process=self.intra_process
        )
        self.executor.add_node(self.nodes[name])

    def stop(self, name: str) -> None:
        """End a node of the graph, at once and without a word."""
        self._remove(self.nodes.pop(name))

    def add(self, node: NodeT) -> NodeT:
        """Run another node on the executor, and end it with the graph."""
        self._others.append(node)
        self.executor.add_node(node)
        return node

    def end(self, node: Node) -> None:
        """End a node that `add` has been given."""
        self._others.remove(node)
        self._remove(node)

    def _remove(self, node: Node) -> None:
        self.executor.remove_node(node)
        node.destroy_node()

    def counts(self) -> Counter[str]:
        """Return the events that a user should know of, by node and kind: of the graph and of those that were added."""
        every = (*self.nodes.values(), *self._others)
        counted = ((node.get_name(), getattr(node, "counts", {})) for node in every)
        return Counter({f"{name}: {kind}": n for name, counts in counted for kind, n in counts.items()})


class Processes:
    """One process for each node; those that end are started again.

    Processes hear of each other one by one, and what is said before is lost. So in lockstep no tick passes which the
    monitor, in a process of its own as well, has not heard.

    Attributes:
        restarts: How often each node was started again.
    """

    def __init__(self, parameters: Parameters, *, restart_limit: int = RESTART_LIMIT) -> None:
        """Start the nodes.

        Args:
            parameters: Of each node.
            restart_limit: Times that a node is started again before the graph is given up.
        """
        self._restart_limit = restart_limit
        self.restarts: Counter[str] = Counter()
        self._ends: list[tuple[float, str]] = []
        self._silent: Counter[str] = Counter()  # ends of each node in a row without an answer before
        self._kept: dict[str, int] = {}
        # A folder each: what the simulator is told, such as seeds, lies nowhere near a module's process.
        self._folders = {name: RunFolder() for name in parameters}
        keep_memories(parameters, {name: folder.path for name, folder in self._folders.items()})
        parameters["simulator"]["await_monitor"] = True
        for name, values in parameters.items():
            write_parameters({name: values}, self._parameter_file(name))
        self._children = {name: self._start(name) for name in parameters}

    def __enter__(self) -> Processes:
        """Return these processes."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Stop them."""
        self.stop()

    def kill(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a node."""
        self._children[name].send_signal(number)

    def supervise(self, *, begun: bool = False) -> None:
        """Start again what has ended.

        Args:
            begun: Whether the graph has answered a tick, so that no node's input was bad when it started.

        Raises:
            GraphError: If a node could not start, or has ended too often.
        """
        for name, child in self._children.items():
            status = child.poll()
            if status is None:
                continue
            if status == USAGE_ERROR and not begun:
                raise GraphError(f"the {name} node could not start")
            self._silent[name] = 0 if self._when_kept(name) != self._kept[name] else self._silent[name] + 1
            if self._silent[name] == SILENT_LIMIT:
                ends = f"{SILENT_LIMIT} times without an answer to a tick"
                raise GraphError(f"the {name} node has ended {ends}, {self._last_words(name, status)}")
            if self.restarts[name] == self._restart_limit:
                times = self._restart_limit + 1
                raise GraphError(f"the {name} node has ended {times} times, {self._last_words(name, status)}")
            self.restarts[name] += 1
            self._ends.append((time.monotonic(), name))
            self._children[name] = self._start(name)

    def counts(self) -> Counter[str]:
        """Return how often which node was started again."""
        return Counter({f"{name}: restarts": n for name, n in self.restarts.items()})

    def ghosts(self, name: str) -> int:
        """Return how many processes of a node have ended so lately that others may still take them for alive."""
        now = time.monotonic()
        self._ends = [(ended, node) for ended, node in self._ends if now - ended < LEASE]
        return sum(node == name for _, node in self._ends)

    def stop(self) -> None:
        """End all processes."""
        if children.stop(self._children.values()):
            clear_shared_memory()
        for folder in self._folders.values():
            folder.remove()

    def _when_kept(self, name: str) -> int:
        """Return when a node has last kept what it remembers, as it does with each answer [ns]; 0: never."""
        file = _memory(self._folders[name].path, name)
        return file.stat().st_mtime_ns if file.exists() else 0

    def _last_words(self, name: str, status: int) -> str:
        file = self._last_word(name)
        said = " ".join(file.read_text().split()) if file.exists() else ""
        return f"with status {status} at last" + (f": {said}" if said else "")

    def _last_word(self, name: str) -> Path:
        return self._folders[name].path / "last_word"

    def _parameter_file(self, name: str) -> Path:
        return self._folders[name].path / "parameters.yaml"

    def _start(self, name: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", _KINDS[name].__module__, "--ros-args"]
        self._kept[name] = self._when_kept(name)
        self._last_word(name).unlink(missing_ok=True)
        command += ["--params-file", str(self._parameter_file(name))]
        return children.start(command, last_word=self._last_word(name))
