"""`ros2 topic pub`."""

from __future__ import annotations

import argparse
import time

from builtin_interfaces.msg import Time

from mujoban_msgs_py.ros2.messages import fill, parse_values
from mujoban_msgs_py.ros2.session import (
    Session,
    add_discovery_options,
    add_qos_options,
    check_rate,
    choose_qos,
    full_name,
    import_type,
)
from mujoban_msgs_py.ros2.verbs import Verbs

_MATCHED = 0.2
"""Seconds that a subscriber has to find the publisher that has found it; what is said before is lost to it."""


def add_verb(verbs: Verbs) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser("pub", help="Publish a message to a topic")
    parser.add_argument("topic_name", help="Name of the topic to publish to (e.g. '/chatter')")
    parser.add_argument("message_type", help="Type of the message (e.g. 'std_msgs/msg/String')")
    parser.add_argument("values", nargs="?", default="{}", help="Values to fill the message with in YAML format")
    parser.add_argument("-r", "--rate", type=float, default=1.0, metavar="N", help="Publishing rate in Hz (1)")
    parser.add_argument("-p", "--print", type=int, default=1, metavar="N", help="Only print every N-th message")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("-1", "--once", action="store_true", help="Publish one message and exit")
    group.add_argument("-t", "--times", type=int, default=0, help="Publish this number of times and then exit")
    parser.add_argument(
        "-w", "--wait-matching-subscriptions", type=int, metavar="N", help="Wait until finding N subscriptions"
    )
    parser.add_argument("--keep-alive", type=float, default=0.1, metavar="N", help="Stay for N seconds after the last")
    add_qos_options(parser)
    add_discovery_options(parser)
    parser.set_defaults(run=publish)


def publish(options: argparse.Namespace) -> int:
    """Publish a message, once, several times or until interrupted."""
    check_rate(options.rate)
    kind = import_type(options.message_type, "msg")
    values = parse_values(options.values)
    fill(kind(), values, Time())  # what does not fit is refused before anybody is waited for
    times = 1 if options.once else options.times
    # As the genuine command: a message that is sent a few times only should reach somebody.
    wanted = options.wait_matching_subscriptions
    if wanted is None:
        wanted = 1 if times else 0
    with Session(options) as session:
        publisher = session.node.create_publisher(kind, full_name(options.topic_name), choose_qos(options))
        while publisher.get_subscription_count() < wanted:
            print(f"Waiting for at least {wanted} matching subscription(s)...", flush=True)
            session.until(lambda: publisher.get_subscription_count() >= wanted, 1.0)
        if wanted:
            session.spin_for(_MATCHED)
        print("publisher: beginning loop", flush=True)
        count, due = 0, time.monotonic()
        while True:
            message = kind()
            fill(message, values, session.node.get_clock().now().to_msg())
            count += 1
            publisher.publish(message)
            if options.print and count % options.print == 0:
                print(f"publishing #{count}: {message!r}\n", flush=True)
            if count == times:
                session.spin_for(options.keep_alive)
                return 0
            # By a schedule, or each would come later by what it takes; those that are missed are not made up for.
            due = max(due + 1 / options.rate, time.monotonic())
            session.spin_for(due - time.monotonic())
