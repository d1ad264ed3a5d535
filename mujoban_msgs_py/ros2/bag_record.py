"""`ros2 bag record`."""

from __future__ import annotations

import argparse
import re
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Final

from mujoban_core.signals import StopSignal
from mujoban_msgs_py.bags import BagError, BagWriter
from mujoban_msgs_py.bags.metadata import qos_profile
from mujoban_msgs_py.ros2.session import (
    CommandError,
    Session,
    full_name,
    import_type,
    is_hidden,
    make_qos,
    qos_of_publishers,
)
from mujoban_msgs_py.ros2.verbs import Verbs

DEPTH: Final = 1000
"""Messages kept for the recorder while it writes a chunk."""


def add_verb(verbs: Verbs) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser("record", help="Record ROS data to a bag")
    parser.add_argument("topics", nargs="*", help="Topics to be recorded")
    parser.add_argument("--topics", nargs="+", dest="more_topics", default=[], help="Topics to be recorded")
    parser.add_argument("-a", "--all", action="store_true", help="Record all topics")
    parser.add_argument("-e", "--regex", help="Record topics whose names match this regular expression")
    parser.add_argument("--exclude-topics", nargs="+", default=[], help="Topics not to be recorded")
    parser.add_argument("--include-hidden-topics", action="store_true", help="Record also hidden topics")
    parser.add_argument("-o", "--output", help="Destination of the bag; default is a name with the date")
    parser.add_argument("-s", "--storage", choices=["mcap"], default="mcap", help="Storage to be used")
    parser.add_argument("--use-sim-time", action="store_true", help="Use simulated time: that of /clock")
    parser.add_argument("--polling-interval", type=int, default=100, metavar="MS", help="Between looks for topics")
    parser.set_defaults(run=record)


class Recorder:
    """Subscribes to the topics that are wanted as they appear, and writes what they deliver, serialised as it is."""

    def __init__(self, session: Session, bag: BagWriter, options: argparse.Namespace) -> None:
        """Prepare to record."""
        self._session = session
        self._bag = bag
        self._wanted = {full_name(name) for name in (*options.topics, *options.more_topics)}
        self._excluded = {full_name(name) for name in options.exclude_topics}
        self._sim_time = options.use_sim_time
        self._all, self._hidden = options.all, options.include_hidden_topics
        self._pattern = re.compile(options.regex) if options.regex else None
        self._seen: set[str] = set()
        self._log = session.node.get_logger().get_child("rosbag2_recorder")

    def begin(self) -> None:
        """Wait for /clock where its time is wanted: until then it is 0, which would be the bag's beginning."""
        if self._sim_time:
            self._log.info("use_sim_time set, waiting for /clock before starting recording...")
            clock = self._session.node.get_clock()
            self._session.until(lambda: clock.now().nanoseconds > 0, None)
        self._log.info("Recording...")

    def look(self) -> None:
        """Subscribe to topics that have appeared."""
        for name, types in self._session.node.get_topic_names_and_types():
            if name in self._seen or not self._is_wanted(name):
                continue
            self._seen.add(name)
            try:
                self._subscribe(name, types[0])
            except (BagError, CommandError) as error:
                self._log.warning(f"Topic '{name}' is not recorded: {error}")

    def _is_wanted(self, name: str) -> bool:
        if name in self._excluded:
            return False
        if name in self._wanted:
            return True
        matches = self._all or (self._pattern is not None and self._pattern.search(name) is not None)
        return matches and (self._hidden or not is_hidden(name))

    def _subscribe(self, name: str, type_name: str) -> None:
        kind = import_type(type_name, "msg")
        reliable, latched = qos_of_publishers(self._session, name)
        self._bag.add_topic(name, type_name, [qos_profile(latched=latched, reliable=reliable)])
        profile = make_qos(DEPTH, reliable=reliable, latched=latched)
        self._session.node.create_subscription(kind, name, partial(self._write, name), profile, raw=True)
        self._log.info(f"Subscribed to topic '{name}'")

    def _write(self, name: str, data: bytes) -> None:
        self._bag.write(name, self._session.node.get_clock().now().nanoseconds, bytes(data))


def record(options: argparse.Namespace) -> int:
    """Record until interrupted."""
    if not (options.all or options.topics or options.more_topics or options.regex):
        raise CommandError("nothing to record: name topics, or use --all or --regex")
    path = Path(options.output or f"rosbag2_{datetime.now():%Y_%m_%d-%H_%M_%S}")
    try:
        if options.regex:
            re.compile(options.regex)
    except re.error as error:
        raise CommandError(f"--regex '{options.regex}' is not a regular expression: {error}") from None
    with (
        StopSignal(deferred=False) as stop,
        Session(options, sim_time=options.use_sim_time) as session,
        BagWriter(path) as bag,
    ):
        recorder = Recorder(session, bag, options)
        with suppress(KeyboardInterrupt):
            recorder.begin()
            stop.deferred = True  # a message that is being written is written, and counted
            while not stop.requested:
                recorder.look()
                session.spin_for(max(options.polling_interval, 1) / 1000)
    return 0
