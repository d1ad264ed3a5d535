"""`ros2 topic list|info|type|hz`; `echo` and `pub` have files of their own."""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from typing import Any

from mujoban_msgs_py.ros2 import topic_echo, topic_pub
from mujoban_msgs_py.ros2.session import (
    CommandError,
    Session,
    add_discovery_options,
    full_name,
    import_type,
    is_hidden,
    make_qos,
)


def add_verbs(commands: Any) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("topic", help="Various topic related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    topic_echo.add_verb(verbs)
    _add_hz(verbs)
    parser = verbs.add_parser("info", help="Print information about a topic")
    parser.add_argument("topic_name")
    parser.add_argument("-v", "--verbose", action="store_true", help="Print the nodes behind it and their QoS")
    add_discovery_options(parser)
    parser.set_defaults(run=show_info)
    parser = verbs.add_parser("list", help="Output a list of available topics")
    parser.add_argument("-t", "--show-types", action="store_true", help="Additionally show the topic type")
    parser.add_argument("-c", "--count-topics", action="store_true", help="Only display the number of topics")
    parser.add_argument("--include-hidden-topics", action="store_true", help="Consider hidden topics as well")
    parser.add_argument("-v", "--verbose", action="store_true", help="List full details about each topic")
    add_discovery_options(parser)
    parser.set_defaults(run=list_topics)
    topic_pub.add_verb(verbs)
    parser = verbs.add_parser("type", help="Print a topic's type")
    parser.add_argument("topic_name")
    add_discovery_options(parser)
    parser.set_defaults(run=show_type)


def _add_hz(verbs: Any) -> None:
    parser = verbs.add_parser("hz", help="Print the average publishing rate to screen")
    parser.add_argument("topic_name")
    parser.add_argument("-w", "--window", type=int, default=10000, help="Messages over which the rate is taken")
    parser.add_argument("--wall-time", action="store_true", help="Accepted for compatibility: rates are by wall time")
    add_discovery_options(parser)
    parser.set_defaults(run=measure_rate)


def list_topics(options: argparse.Namespace) -> int:
    """Print the topics."""
    with Session(options) as session:
        found = session.settle(session.node.get_topic_names_and_types)
        names = {name: types for name, types in sorted(found) if options.include_hidden_topics or not is_hidden(name)}
        if options.count_topics:
            print(len(names))
        elif options.verbose:
            for title, count, what in (
                ("Published", session.node.count_publishers, "publisher"),
                ("Subscribed", session.node.count_subscribers, "subscriber"),
            ):
                print(f"{title} topics:")
                for name, types in names.items():
                    if number := count(name):
                        print(f" * {name} [{', '.join(types)}] {number} {what}{'s' if number > 1 else ''}")
                print()
        else:
            for name, types in names.items():
                print(f"{name} [{', '.join(types)}]" if options.show_types else name)
    return 0


def show_info(options: argparse.Namespace) -> int:
    """Print a topic's type and how many publish and subscribe to it."""
    topic = full_name(options.topic_name)
    with Session(options) as session:
        kind = session.topic_type(topic)

        def endpoints() -> tuple[int, int]:
            return session.node.count_publishers(topic), session.node.count_subscribers(topic)

        publishers, subscribers = session.settle(endpoints)
        print(f"Type: {kind}\n")
        print(f"Publisher count: {publishers}\n")
        if options.verbose:
            for info in session.node.get_publishers_info_by_topic(topic):
                print(info, end="\n\n")
        print(f"Subscription count: {subscribers}")
        if options.verbose:
            print()
            for info in session.node.get_subscriptions_info_by_topic(topic):
                print(info, end="\n\n")
    return 0


def show_type(options: argparse.Namespace) -> int:
    """Print a topic's type."""
    with Session(options) as session:
        print(session.topic_type(full_name(options.topic_name)))
    return 0


class Rate:
    """Statistics of the time between messages."""

    def __init__(self, window: int) -> None:
        """Remember at most `window` intervals, in seconds."""
        self._intervals: deque[float] = deque(maxlen=window)
        self._last: float | None = None
        self.fresh = False

    def add(self, moment: float) -> None:
        """Note a message that arrived at a moment in seconds."""
        if self._last is not None:
            self._intervals.append(moment - self._last)
            self.fresh = True
        self._last = moment

    def __str__(self) -> str:
        count = len(self._intervals)
        mean = sum(self._intervals) / count
        deviation = math.sqrt(sum((x - mean) ** 2 for x in self._intervals) / count)
        return (
            f"average rate: {1 / mean if mean > 0 else 0:.3f}\n\tmin: {min(self._intervals):.3f}s "
            f"max: {max(self._intervals):.3f}s std dev: {deviation:.5f}s window: {count}"
        )


def measure_rate(options: argparse.Namespace) -> int:
    """Print the rate of a topic every second."""
    if options.window < 1:
        raise CommandError(f"--window must be a positive integer, got {options.window}")
    topic = full_name(options.topic_name)
    with Session(options) as session:
        complaint = f"topic [{topic}] does not appear to be published yet"
        kind = import_type(session.topic_type(topic, complaint), "msg")
        rate = Rate(options.window)
        session.node.create_subscription(
            kind, topic, lambda _: rate.add(time.perf_counter()), make_qos(10, reliable=False), raw=True
        )
        while True:
            session.spin_for(1.0)
            if rate.fresh:
                rate.fresh = False
                print(rate, flush=True)
