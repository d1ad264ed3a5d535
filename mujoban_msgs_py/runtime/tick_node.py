"""The base of every node but the simulator: join the inputs of a tick, answer once, answer again when asked.

A tick is known by its stamp. The simulator offers a tick by publishing its observation, and offers it again
when no answer comes. A node that has answered already then repeats its answer from a cache, so that a
neighbour which was restarted in between receives what it has missed.
"""

from __future__ import annotations

import inspect
import re
import sys
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, Unpack

import rclpy
from mujoban_msgs.msg import Episode
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from mujoban_core.children import end_with_parent, telling
from mujoban_core.signals import StopSignal, interruptible
from mujoban_msgs_py.adapted import Adapted
from mujoban_msgs_py.arrivals import Arrival
from mujoban_msgs_py.decoders import DECODERS, checked
from mujoban_msgs_py.listening import belongs, reject, subscribe
from mujoban_msgs_py.run_identifier import ANY
from mujoban_msgs_py.runtime.descriptors import NodeOptions, warn_of_unknown
from mujoban_msgs_py.runtime.diagnostics import PERIOD, Condition, report_on
from mujoban_msgs_py.runtime.discovery import chosen_domain, confine_discovery
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.intra_process import TopicPublisher
from mujoban_msgs_py.runtime.jumps import Jumps
from mujoban_msgs_py.runtime.shared_memory import mapped_segments, release_segments
from mujoban_msgs_py.seldom import is_due
from mujoban_msgs_py.synchroniser import Synchroniser
from mujoban_msgs_py.topics import EPISODE, QUEUE_DEPTH, Message, Topic

_DEADLINE = 3600.0
"""Seconds after which a wait begins anew."""
PATIENCE = 60
"""Repeated offers of a tick after which a node answers without what it still waits for: one that was killed is back by
then, and has said it."""

_USAGE = "--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO, as every node of ROS takes them"


class Output(NamedTuple):
    """A message to publish."""

    publisher: TopicPublisher
    message: Message | Adapted | bytes
    """Bytes are one that is serialised already."""


class TickNode(GraphNode):
    """A node that answers each tick of the simulator.

    Attributes:
        counts: Events that a user should know of, such as rejected messages.
        patience: Offers of the same tick until `answer` is told that waiting will not help.
        run: Identifier of the run that it answers.
    """

    patience = PATIENCE
    run = ANY

    def __init__(self, name: str, **options: Unpack[NodeOptions]) -> None:
        """Make the node; `open_inputs` starts it."""
        super().__init__(name, **options)
        self.counts: Counter[str] = Counter()
        self._join: Synchroniser | None = None
        self._handled = -1
        self._outputs: Sequence[Output] = ()
        self._open: tuple[int, dict[str, Any]] | None = None
        self._offers = 0
        self._jumps = Jumps()
        self._answered = 0
        self._rated = (0, time.monotonic())
        self._rate = 0.0

    @property
    def dropped(self) -> Counter[str]:
        """Messages that belong to no tick that was ever complete, by topic."""
        return Counter() if self._join is None else self._join.dropped

    def _condition(self) -> Condition:
        (before, since), now = self._rated, time.monotonic()
        if now - since > PERIOD / 2:  # of less, such as until somebody else begins to listen, no rate can be told
            self._rate, self._rated = (self._answered - before) / (now - since), (self._answered, now)
        values = {
            "ticks answered": self._answered,
            "ticks/s": f"{self._rate:.1f}",
            "dropped messages": self.dropped.total(),
            **self.counts,
        }
        return Condition("answering" if self._rate else "waiting for a tick", values)

    @abstractmethod
    def answer(self, stamp: int, episode: Episode, inputs: dict[str, Any], *, insist: bool) -> Sequence[Output] | None:
        """Return what to publish for a tick, or None to be asked again (see `retry`).

        Args:
            stamp: Of the tick, in nanoseconds of simulated time.
            episode: The episode's message of this tick.
            inputs: Topic name -> decoded message.
            insist: Whether the simulator has offered the tick repeatedly: waiting will not help.
        """

    def check(self, topic: Topic, item: Any) -> None:
        """Raise a ValueError if what a message says, which is sound in itself, is nothing to this node."""

    def open_inputs(self, inputs: Sequence[Topic]) -> None:
        """Subscribe to `/episode` and to what `answer` needs besides, each as its topic's reader gives it."""
        readers = {EPISODE: checked(EPISODE), **{topic: DECODERS[topic] for topic in inputs}}
        self._join = Synchroniser([topic.name for topic in readers])
        report_on(self, self._condition)
        for topic, decode in readers.items():
            receive = partial(self._receive, topic, decode)
            # What was said before this node came belongs to ticks that are over; the open one is offered again.
            subscribe(self, topic, receive, live_qos())

    def keep(self, stamp: int, outputs: Sequence[Output]) -> None:
        """Note that a tick is answered, before anybody else knows; `take_up` goes on from there."""

    def take_up(self, stamp: int, outputs: Sequence[Output]) -> None:
        """Go on after the tick that another process had answered last, and say its answer again to who has missed it.

        Args:
            stamp: Of the tick.
            outputs: The answer, with messages as they are or serialised.
        """
        self._handled, self._outputs = stamp, outputs
        self._publish()

    def start_anew(self) -> None:
        """Forget what was answered and is open: time has jumped back."""
        self._handled, self._open = -1, None

    def retry(self) -> None:
        """Ask `answer` again about the tick that it could not answer yet."""
        if self._open is None or self.ended:
            return
        stamp, inputs = self._open
        episode = inputs[EPISODE.name]
        outputs = self.answer(stamp, episode, inputs, insist=self._offers > self.patience)
        if outputs is None:
            return
        self._open, self._handled, self._outputs = None, stamp, outputs
        self._answered += 1
        self.keep(stamp, outputs)
        self._publish()

    def _receive(self, topic: Topic, decode: Callable[[Any], Any] | None, message: Arrival) -> None:
        if self.ended:
            return
        try:
            stamp = message.stamp
            if stamp <= self._handled and topic is not EPISODE:
                return
            item = message.content(decode)
            self.check(topic, item)
        except ValueError as error:
            reject(self, topic.name, error)
            return
        if not belongs(self, topic.name, stamp):
            return
        if topic is EPISODE:
            self._note_offer(stamp, item)
            if stamp <= self._handled:
                return
        assert self._join is not None
        complete = self._join.add(topic.name, stamp, item)
        if complete is not None:
            if self._open is None:
                self._offers = 0
            elif self._open[0] != stamp:
                # Where time does not wait, a tick that is still open has lost its chance, and so has what it waits for.
                self._offers = self.patience + 1
            self._open = (stamp, complete)
            self.retry()

    def _note_offer(self, stamp: int, episode: Episode) -> None:
        jumped = self._jumps.note(stamp, episode.step, self._handled)
        if stamp == self._handled and (self._outputs or episode.ended):
            self._publish()
        elif stamp == self._handled:
            # It was answered as an end, with nothing: that end was not the simulator's word.
            if is_due(self, "contradiction"):
                self.get_logger().error(f"{EPISODE.name} contradicts itself at {stamp} ns: two simulators?")
            self.counts["contradictory episodes"] += 1
            self._handled = stamp - 1
        elif jumped:
            if is_due(self, "jump back"):
                self.get_logger().warning("simulated time jumped back: starting anew")
            self.start_anew()
        elif self._open is not None and stamp == self._open[0]:
            self._offers += 1
            self.retry()

    def _publish(self) -> None:
        for publisher, message in self._outputs:
            publisher.publish(message)


def live_qos(depth: int = QUEUE_DEPTH) -> QoSProfile:
    """Return the QoS of a reader that wants nothing from before its time, and after that everything."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)


def spin(executor: Executor, until: Future, stop: StopSignal) -> None:
    """Run an executor until a future is done.

    An `EventsExecutor` looks at its deadline only when it has nothing to do, which in a busy graph takes seconds, so
    a signal completes the future that it waits for: then it returns after the callback that runs. It must be given a
    deadline all the same: without one it waits until the end of its clock, which overflows, and then polls at full
    load while its other threads starve.

    Args:
        executor: With its nodes.
        until: The future.
        stop: Heeds signals.

    Raises:
        Interrupted: If the process was asked to end.
    """
    ended = Future()

    def end(_: Future | None = None) -> None:
        ended.set_result(None)

    until.add_done_callback(end)
    with stop.waking(end):
        while not (until.done() or stop.requested):
            executor.spin_until_future_complete(ended, timeout_sec=_DEADLINE)
    stop.check()


def init_ros(args: Sequence[str] | None = None, context: Context | None = None) -> None:
    """Initialise rclpy for `spin`, which looks after signals itself; discovery stays on this host.

    Args:
        args: Command line, with ROS arguments.
        context: What is initialised; None is the default context.

    Raises:
        ValueError: If the environment names no possible ROS domain.
        OSError: If ROS cannot write its log.
    """
    confine_discovery()
    domain = chosen_domain()
    given = None if args is None else list(args)
    try:
        rclpy.init(args=given, context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        folder = re.search(r"log directory '(.*?)'", str(error))
        if folder is None:
            raise
        raise OSError(
            f"ROS cannot write its log to {folder[1]}, expected a folder that can be written to in ROS_LOG_DIR"
        ) from error


@contextmanager
def ros_context(args: Sequence[str] | None = None, context: Context | None = None) -> Iterator[None]:
    """Initialise rclpy as `init_ros` does, and shut it down.

    An error, or an interruption, may come while a node is being made, which nobody then can destroy: what it has in
    shared memory is removed.
    """
    before = mapped_segments()
    try:
        init_ros(args, context)
        yield
    except BaseException:
        rclpy.try_shutdown(context=context)
        release_segments(mapped_segments() - before)
        raise
    rclpy.try_shutdown(context=context)


def run_node(make: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Run one node in a process of its own until it is interrupted or the process that started it ends.

    Args:
        make: Makes the node; a ValueError or OSError is bad input.
        args: Command line, with ROS arguments; None takes that of the process.

    Returns:
        Exit status: 0, as `ros2 launch` expects it of a node that was interrupted, or 2 after one line on stderr
        about bad input, such as arguments that are not ROS's.
    """
    end_with_parent()
    try:
        # Of the process's own the first is its name.
        given = _without_ros_args(args)[args is None :]
        if {"-h", "--help"} & {*given}:
            print(*_descriptions(make), f"Arguments: {_USAGE}", sep="\n\n")
            return 0
        if given:
            raise ValueError(f"{given[0]} is no option of a node, expected {_USAGE}")
        with telling(), interruptible(), StopSignal(deferred=False) as stop, ros_context(args):
            _run(make, stop)
    except KeyboardInterrupt:
        pass
    except (ValueError, OSError, ParameterException) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


def _descriptions(make: Callable[[], Node]) -> list[str]:
    """Return what a node says of itself, and of the parameters that it has by its bases."""
    own = inspect.getdoc(make) or ""  # its base's, where it has none
    bases = make.__mro__[1:] if isinstance(make, type) else ()
    told = {base.__name__: inspect.cleandoc(base.__doc__ or "") for base in bases}
    return [own, *(f"{name}: {text}" for name, text in told.items() if "\nParameters:\n" in text and text != own)]


def _without_ros_args(args: Sequence[str] | None) -> Sequence[str]:
    """Return what no argument of ROS is; those that are none, and files that they name, are a ValueError."""
    try:
        return remove_ros_args(args)
    except RuntimeError as error:  # of rcl's parser: it names the argument, and then lines of its own source
        said = re.sub(r", at \S+:\d+", "", str(error)).removeprefix("Failed to parse ROS arguments: ")
        raise ValueError(f"bad ROS arguments: {said}, expected {_USAGE}") from None


def _run(make: Callable[[], Node], stop: StopSignal) -> None:
    node = make()
    warn_of_unknown(node)
    stop.deferred = True
    try:
        executor = EventsExecutor()
        executor.add_node(node)
        spin(executor, Future(), stop)
    finally:
        node.destroy_node()
