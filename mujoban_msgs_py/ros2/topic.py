"""`ros2 topic list|info|type`; `echo`, `pub` and the measurements have files of their own."""

from __future__ import annotations

import argparse

from mujoban_msgs_py.ros2 import topic_echo, topic_measure, topic_pub
from mujoban_msgs_py.ros2.session import (
    Session,
    add_discovery_options,
    full_name,
    is_hidden,
)
from mujoban_msgs_py.ros2.verbs import Verbs


def add_verbs(commands: Verbs) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("topic", help="Various topic related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    topic_echo.add_verb(verbs)
    topic_measure.add_verbs(verbs)
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
