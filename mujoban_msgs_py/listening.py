"""Listen to a topic without trusting those who publish there.

A graph is open: whoever shares its domain can publish on its topics. A message that is not what its topic carries is
dropped, counted and named by its topic; what passes is sound, but may still come from somebody who does not belong to
the graph: `PublisherWatch` names them. And whoever shares the domain can listen: `TruthWatch` names who does so to the
ground truth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from mujoban_msgs_py.arrivals import Arrival, Handed, Receive, Serialised
from mujoban_msgs_py.checks import ConversionError
from mujoban_msgs_py.decoders import DECODERS, Decode
from mujoban_msgs_py.raw import Steady
from mujoban_msgs_py.run_identifier import ANY, run_of
from mujoban_msgs_py.seldom import is_due
from mujoban_msgs_py.topics import PUBLISHERS, TRUTH_TOPICS, Topic

if TYPE_CHECKING:
    from mujoban_msgs_py.runtime.intra_process import IntraProcess

WATCH_PERIOD: Final = 1.0
"""Seconds between two looks at who publishes."""
_THOROUGH: Final = 10
"""Of so many looks one asks for every publisher's name, which takes 20 ms; the others count them."""
LEASE: Final = 30.0
"""Seconds for which the publishers of a process that was killed are known at most: Fast DDS gives 20, and looks."""
_NAMELESS: Final = "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_"
_PATIENCE: Final = 5
"""Looks in a row for which a publisher may be without a name."""
REJECTED: Final = "rejected messages"
"""Kind under which `Listener.counts` has what was dropped."""
ANOTHER_RUN: Final = "messages of another run"
"""Kind under which it has what is sound, but not of the run that the node belongs to."""
OVERHEARD: Final = "listeners to the ground truth"
"""Kind under which it has nodes that `TruthWatch` names."""
_GRAPH: Final = frozenset(f"/{name}" for name in (*PUBLISHERS.values(), "live", "video", "viz"))
"""Nodes of the graph; reports name those of them that are told the truth."""


class Received(NamedTuple):
    """A message that is what its topic carries."""

    stamp: int
    """Of the tick [ns of simulated time]."""
    content: Any
    """What the reader of the topic made of it."""
    raw: bytes
    """CDR; empty if a node of the same process has handed the message over."""


def subscribe(node: Node, topic: Topic, receive: Receive, qos: QoSProfile | None = None) -> Subscription:
    """Subscribe to a topic of the graph, also to what nodes of the same process hand over.

    Args:
        node: Who subscribes; if it has an `intra_process`, that hands over.
        topic: The topic.
        receive: Called with every message.
        qos: The topic's own by default.
    """
    chosen = qos or topic.qos
    between: IntraProcess | None = getattr(node, "intra_process", None)
    if between is not None:
        between.read(node, topic, receive, chosen.depth)

    def on_message(message: bytes) -> None:
        receive(Serialised(message, topic.type))

    return node.create_subscription(topic.type, topic.name, on_message, chosen, raw=True)


def listen(
    node: Node,
    topic: Topic,
    receive: Callable[[Received], None],
    *,
    qos: QoSProfile | None = None,
    decode: Decode | None = None,
    otherwise: Callable[[ConversionError], Any] | None = None,
    steady: bool = False,
) -> Subscription:
    """Subscribe to a topic of the graph.

    Args:
        node: Who listens; if it has `counts`, what is dropped is counted there under `REJECTED`. If it has a `run`, it
            hears that one alone.
        topic: The topic.
        receive: Called with every message that is sound.
        qos: The topic's own by default.
        decode: Reads a message, in place of the topic's reader; a ValueError drops it.
        otherwise: Returns what stands for the content of a message that says what its topic does not carry.
        steady: Whether the topic says the same for many ticks, and its reader leaves the header out (see `Steady`).
    """
    reader = DECODERS[topic] if decode is None else decode
    repeated = Steady(topic.type, reader) if steady else None

    def content_of(message: Arrival) -> Any:
        try:
            if repeated is None or isinstance(message, Handed):
                return message.content(reader)
            return repeated(message.raw)
        except ConversionError as error:
            if otherwise is None:
                raise
            return otherwise(error)

    def on_message(message: Arrival) -> None:
        try:
            stamp, content = message.stamp, content_of(message)
        except ValueError as error:
            reject(node, topic.name, error)
            return
        if belongs(node, topic.name, stamp):
            receive(Received(stamp, content, message.raw))

    return subscribe(node, topic, on_message, qos)


def reject(node: Node, topic: str, reason: object) -> None:
    """Count a message that is dropped and name its topic, at most once per `LOG_PERIOD`."""
    _count(node, REJECTED)
    if is_due(node, topic):
        node.get_logger().error(f"rejected a message on {topic}: {' '.join(str(reason).split())}")


def belongs(node: Node, topic: str, stamp: int) -> bool:
    """Tell whether a message of a stamp [ns] is of the run that a node belongs to; if not, count and report it."""
    run = getattr(node, "run", ANY)
    if run in (ANY, run_of(stamp)):
        return True
    refuse_run(node, f"{topic} has messages of run {run_of(stamp)}")
    return False


def refuse_run(node: Node, what: str) -> None:
    """Count a message of another run, and say what it was, at most once per `LOG_PERIOD`."""
    _count(node, ANOTHER_RUN)
    if is_due(node, ANOTHER_RUN):
        node.get_logger().error(f"another run is in this ROS domain: {what}, which is none of this run's")


def _count(node: Node, kind: str) -> None:
    counts: Counter[str] | None = getattr(node, "counts", None)
    if counts is not None:
        counts[kind] += 1


class PublisherWatch:
    """Names those who publish on a graph's topics and do not belong to it, once each.

    A topic of the graph has one publisher, the node of `topics.PUBLISHERS`: who has another name does not belong to the
    run, nor does a second one of that name, which is of another run or was started by hand.

    Attributes:
        seen: (topic, node) of all that were named.
        ghosts: Tells how many publishers a node may have on a topic besides the one that lives: those of processes that
            were killed stay known for `LEASE` seconds.
    """

    def __init__(self, node: Node, publishers: Mapping[str, str] = PUBLISHERS) -> None:
        """Look on behalf of a node, every `WATCH_PERIOD` seconds, at topics and the nodes that publish on them."""
        self._node, self._publishers = node, publishers
        self._looks = 0
        self._counts: dict[str, int] = {}
        self._nameless: Counter[str] = Counter()
        self.seen: set[tuple[str, str]] = set()
        self.ghosts: Callable[[str], int] = lambda name: 0
        node.create_timer(WATCH_PERIOD, self.look)

    def look(self) -> None:
        """Report who has come since the last look."""
        new = {(topic, name) for topic in self._topics() for name in self._foreign(topic)} - self.seen
        self.seen |= new
        for name in sorted({name for _, name in new}):
            _count(self._node, "foreign publishers")
            their = ", ".join(sorted(f"{topic} (of /{self._publishers[topic]})" for topic, n in new if n == name))
            second = "a second " if all(name == f"/{self._publishers[topic]}" for topic, n in new if n == name) else ""
            self._node.get_logger().error(
                f"foreign publisher: {second}node {name} publishes on {their}; the run may be disturbed. Stop it, or "
                "give it another ROS_DOMAIN_ID"
            )

    def _foreign(self, topic: str) -> set[str]:
        """Return the nodes that publish on a topic and have no business there."""
        own = f"/{self._publishers[topic]}"
        names = Counter(map(_name, self._node.get_publishers_info_by_topic(topic)))
        ghosts = self.ghosts(self._publishers[topic])
        if names[own] <= 1 + ghosts:
            del names[own]
        # Who has only just come, or is going, is not known by name for a moment; who was killed may lose it for longer.
        self._nameless[topic] = self._nameless[topic] + 1 if names[_NAMELESS] > ghosts else 0
        if self._nameless[topic] <= _PATIENCE:
            del names[_NAMELESS]
        return set(names)

    def _topics(self) -> list[str]:
        """Return the topics whose publishers may be others than at the last look, or were not all known."""
        counts = {topic: self._node.count_publishers(topic) for topic in self._publishers}
        every = self._looks % _THOROUGH == 0
        changed = [t for t, n in counts.items() if every or n != self._counts.get(t) or n > 1 or self._nameless[t]]
        self._looks, self._counts = self._looks + 1, counts
        return changed


class TruthWatch:
    """Names those who listen to the ground truth and are none of the graph's nodes, once each.

    A module that is told the truth says so, and reports name it; a node that it opened by itself they would not.

    Attributes:
        seen: All that were named.
    """

    def __init__(self, node: Node) -> None:
        """Look on behalf of a node, every `WATCH_PERIOD` seconds."""
        self._node = node
        self._counts: dict[str, int] = {}
        self.seen: set[str] = set()
        node.create_timer(WATCH_PERIOD, self.look)

    def look(self) -> None:
        """Report who has come since the last look."""
        new = {name for topic in TRUTH_TOPICS for name in self._come(topic.name)} - _GRAPH - self.seen
        self.seen |= new
        for name in sorted(new):
            _count(self._node, OVERHEARD)
            self._node.get_logger().warning(
                f"node {name} listens to the ground truth and is none of the graph's: if a module has opened it, this "
                "run's result is that of a module which is told the truth"
            )

    def _come(self, topic: str) -> set[str]:
        """Return who listens to a topic, if there are others than at the last look, or not all were known."""
        count = self._node.count_subscribers(topic)
        if count == self._counts.get(topic):
            return set()
        names = set(map(_name, self._node.get_subscriptions_info_by_topic(topic)))
        self._counts[topic] = count if _NAMELESS not in names else -1
        return names - {_NAMELESS}


def _name(end: TopicEndpointInfo) -> str:
    """Return the name of the node that has one end of a topic."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
