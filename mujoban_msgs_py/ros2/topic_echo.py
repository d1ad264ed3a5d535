"""`ros2 topic echo`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from mujoban_msgs_py.ros2.messages import is_message, to_csv, to_yaml
from mujoban_msgs_py.ros2.session import (
    CommandError,
    Session,
    add_discovery_options,
    add_qos_options,
    choose_qos,
    full_name,
    import_type,
    qos_of_publishers,
)
from mujoban_msgs_py.ros2.verbs import Verbs


def add_verb(verbs: Verbs) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser("echo", help="Output messages from a topic")
    parser.add_argument("topic_name", help="Name of the topic to listen to (e.g. '/chatter')")
    parser.add_argument("message_type", nargs="?", help="Type of the message (e.g. 'std_msgs/msg/String')")
    parser.add_argument("--csv", action="store_true", help="Output values separated by commas (e.g. for plotting)")
    parser.add_argument("--field", metavar="FIELD", help="Echo a selected field, such as 'pose.position'")
    parser.add_argument("-f", "--full-length", action="store_true", help="Output all elements of arrays and strings")
    parser.add_argument(
        "-l", "--truncate-length", type=int, default=128, help="The length to truncate arrays and strings to (128)"
    )
    parser.add_argument("--no-arr", action="store_true", help="Don't print array fields of messages")
    parser.add_argument("--no-str", action="store_true", help="Don't print string fields of messages")
    parser.add_argument("--flow-style", action="store_true", help="Print collections in the block style")
    parser.add_argument("--no-lost-messages", action="store_true", help="Accepted for compatibility")
    parser.add_argument("--raw", action="store_true", help="Echo the raw binary representation")
    parser.add_argument("--once", action="store_true", help="Print the first message received and then exit")
    parser.add_argument("--timeout", type=float, metavar="N", help="Set a timeout in seconds for waiting")
    add_qos_options(parser)
    add_discovery_options(parser)
    parser.set_defaults(run=echo)


class Printer:
    """Prints messages as the options ask for."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Check the options."""
        if options.truncate_length < 1:
            raise CommandError(f"--truncate-length must be a positive integer, got {options.truncate_length}")
        self._path: Sequence[str] = options.field.split(".") if options.field else ()
        self._csv = options.csv
        self._style: dict[str, Any] = {
            "truncate": None if options.full_length else options.truncate_length,
            "no_arr": options.no_arr,
            "no_str": options.no_str,
        }
        self._flow_style = options.flow_style
        self.count = 0

    def __call__(self, message: object) -> None:
        """Print one message."""
        self.count += 1
        for name in self._path:
            if not is_message(message) or name not in message.get_fields_and_field_types():
                raise CommandError(f"invalid field '{'.'.join(self._path)}': '{name}' is not there")
            message = getattr(message, name)
        if self._csv:
            print(to_csv(message, **self._style), flush=True)
        elif is_message(message):
            print(to_yaml(message, **self._style, flow_style=self._flow_style), end="---\n", flush=True)
        else:
            print(message, end="\n---\n", flush=True)


def echo(options: argparse.Namespace) -> int:
    """Print messages until interrupted."""
    topic = full_name(options.topic_name)
    printer = Printer(options)
    with Session(options) as session:
        type_name = options.message_type or session.topic_type(
            topic, f"topic [{topic}] does not appear to be published yet: its type cannot be determined"
        )
        kind = import_type(type_name, "msg")
        reliable, latched = qos_of_publishers(session, topic)
        profile = choose_qos(options, reliable=reliable, latched=latched)
        waiting: list[object] = []
        session.node.create_subscription(kind, topic, waiting.append, profile, raw=options.raw)
        while True:
            if not session.until(lambda: bool(waiting), options.timeout):
                return 0
            for message in waiting:
                printer(message)
                if options.once:
                    return 0
            waiting.clear()
