"""Hand messages over within a process, as rclcpp does for nodes that it composes (`use_intra_process_comms`).

rclpy sends every message through the middleware, also to a node beside: serialised, sent, received, deserialised once
more. Here the nodes of a process pass each other the messages themselves, while nobody else reads their topic. As soon
as somebody does, in another process or with a plain subscription, the topic goes through the middleware to all.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.timer import Timer

from mujoban_msgs_py.adapted import Adapted, message_of
from mujoban_msgs_py.arrivals import Handed, Receive
from mujoban_msgs_py.decoders import DECODERS
from mujoban_msgs_py.topics import Message, Topic

if TYPE_CHECKING:
    from mujoban_msgs_py.runtime.graph_node import GraphNode

LATE_JOINER_PERIOD: Final = 0.1
"""Seconds between two looks at whether somebody has come who would receive the latest message of a latched topic."""
_AT_ONCE: Final = 32
"""Messages that are delivered until timers, services and the middleware have their turn: those of about a tick."""


class _Reader(NamedTuple):
    node: Node
    receive: Receive
    waiting: deque[Handed]


class IntraProcess:
    """The messages on their way between nodes of one executor.

    Messages are delivered in the order in which they were published, never from within `publish`. A reader that is too
    slow loses the oldest, as its QoS says.
    """

    def __init__(self) -> None:
        """Know of no node yet; those that are made with this one join."""
        self._readers: dict[Topic, list[_Reader]] = {}
        self._turns: deque[_Reader] = deque()
        """Whose message comes next; one turn for each that waits."""
        self._timers: dict[GraphNode, Timer] = {}
        self._armed: Timer | None = None

    def join(self, node: GraphNode) -> None:
        """Let a node publish and read."""
        # A timer that is always due is what an `EventsExecutor` has to be woken by: it takes no guard conditions, and
        # ends the process when a task raises an error.
        timer = self._timers[node] = node.create_timer(0.0, self._deliver)
        timer.cancel()

    def leave(self, node: GraphNode) -> None:
        """Forget a node, and what was on its way to it."""
        self._timers.pop(node, None)
        for readers in self._readers.values():
            readers[:] = [reader for reader in readers if reader.node is not node]
        self._turns = deque(reader for reader in self._turns if reader.node is not node)
        self._armed = None
        self._wake()

    def read(self, node: Node, topic: Topic, receive: Receive, depth: int) -> None:
        """Call a function with every message that is handed over on a topic.

        Args:
            node: Who reads.
            topic: The topic.
            receive: The function.
            depth: Messages that may wait for it.
        """
        self._readers.setdefault(topic, []).append(_Reader(node, receive, deque(maxlen=depth)))

    def readers(self, topic: Topic) -> int:
        """Return how many read a topic."""
        return len(self._readers.get(topic, ()))

    def hand_over(self, topic: Topic, said: Message | Adapted) -> None:
        """Deliver a message to all who read its topic; they and the sender leave it as it is."""
        handed = Handed(said, DECODERS[topic])
        for reader in self._readers.get(topic, ()):
            if len(reader.waiting) < (reader.waiting.maxlen or 0):
                self._turns.append(reader)  # else the oldest one's turn is the new one's
            reader.waiting.append(handed)
        self._wake()

    def _wake(self) -> None:
        if self._turns and self._timers and self._armed is None:
            self._armed = next(iter(self._timers.values()))
            self._armed.reset()

    def _deliver(self) -> None:
        if self._armed is None:
            return
        self._armed.cancel()
        try:
            for _ in range(_AT_ONCE):
                if not self._turns:
                    break
                reader = self._turns.popleft()
                reader.receive(reader.waiting.popleft())
        finally:
            self._armed = None
            self._wake()


class TopicPublisher:
    """Publishes a topic of the graph."""

    def __init__(self, node: GraphNode, topic: Topic, between: IntraProcess | None) -> None:
        """Publish on behalf of a node, within the process by `between`, if there is one."""
        self._node, self._topic, self._between = node, topic, between
        self._publisher = self._open()
        self._unsaid: Message | Adapted | None = None
        """Latest message of a latched topic, if the middleware has not got it."""
        self._has_sent = False
        if between is not None and topic.latched:
            node.create_timer(LATE_JOINER_PERIOD, self._mind_late_joiners)

    def _open(self) -> Publisher:
        return self._node.create_publisher(self._topic.type, self._topic.name, self._topic.qos)

    @property
    def subscriptions(self) -> int:
        """How many read the topic, in this process and in others."""
        return self._publisher.get_subscription_count()

    def publish(self, said: Message | Adapted | bytes) -> None:
        """Publish a message; bytes are one that is serialised already."""
        if isinstance(said, bytes):
            self._send(said)
        elif self._between is None or self._is_heard_outside():
            self._send(message_of(said))
        else:
            self._between.hand_over(self._topic, said)
            if self._topic.latched:
                self._unsaid = said

    def _send(self, message: Message | bytes) -> None:
        self._unsaid, self._has_sent = None, True
        self._publisher.publish(message)

    def _is_heard_outside(self) -> bool:
        assert self._between is not None
        return self._publisher.get_subscription_count() > self._between.readers(self._topic)

    def _mind_late_joiners(self) -> None:
        """Say the latest message to who has come, and see to it that whoever comes does not hear an older one first."""
        if self._unsaid is None:
            return
        if self._is_heard_outside():
            self.publish(self._unsaid)
        elif self._has_sent:
            # What the middleware keeps is out of date; it forgets it with the publisher.
            self._node.destroy_publisher(self._publisher)
            self._publisher, self._has_sent = self._open(), False
