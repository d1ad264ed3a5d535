"""`ros2 bag play`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import Final

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from mujoban_msgs_py.bags import Bag, BagMessage, TopicInfo, open_bag
from mujoban_msgs_py.conversions import clock_to_msg
from mujoban_msgs_py.ros2.session import CommandError, Session, check_rate, full_name, import_type, make_qos
from mujoban_msgs_py.ros2.verbs import Verbs

MATCH_LIMIT: Final = 5.0
"""Seconds within which known subscribers have to be matched before the first message is sent."""
DEPTH: Final = 1000
"""Messages kept for slow subscribers."""


def add_verb(verbs: Verbs) -> None:
    """Add the verb to the parser."""
    parser = verbs.add_parser("play", help="Play back ROS data from a bag")
    parser.add_argument("bag_path", help="Bag to open")
    parser.add_argument("-r", "--rate", type=float, default=1.0, help="Rate at which to play back messages")
    parser.add_argument("--topics", nargs="+", help="Topics to replay")
    parser.add_argument("--exclude-topics", nargs="+", default=[], help="Topics not to replay")
    parser.add_argument(
        "--clock", nargs="?", type=float, const=40.0, default=0.0, metavar="HZ", help="Publish to /clock, at 40 Hz"
    )
    parser.add_argument("-m", "--remap", nargs="+", default=[], metavar="OLD:=NEW", help="Topics to rename")
    parser.add_argument("-d", "--delay", type=float, default=0.0, help="Sleep SEC seconds before play")
    parser.add_argument("-l", "--loop", action="store_true", help="Play the bag again when it has ended")
    parser.add_argument("--start-offset", type=float, default=0.0, help="Start this many seconds into the bag")
    parser.add_argument(
        "--wait-for-all-acked", type=int, default=5000, metavar="MS",
        help="At the end wait so long for subscribers, 0: for ever, -1: not at all",
    )  # fmt: skip
    parser.set_defaults(run=play)


class Player:
    """Publishes a bag's messages, serialised as they are, at the times at which they were recorded."""

    def __init__(self, session: Session, bag: Bag, options: argparse.Namespace) -> None:
        """Make a publisher for every topic that is to be played; one of an unknown type is left out with a warning."""
        self._session = session
        self._bag = bag
        self._rate = options.rate
        renamed = dict(_rename(text) for text in options.remap)
        excluded = {full_name(name) for name in options.exclude_topics}
        wanted = [full_name(n) for n in options.topics] if options.topics else list(bag.topics)
        names = [name for name in wanted if name not in excluded]
        missing = sorted(set(names) - bag.topics.keys())
        if missing:
            raise CommandError(f"no topic {', '.join(missing)} in bag {bag.path}")
        self.publishers: dict[str, Publisher] = {}
        log = session.node.get_logger().get_child("rosbag2_player")
        for name in names:
            try:
                kind = import_type(bag.topics[name].type_name, "msg")
            except CommandError as error:
                log.warning(f"Topic '{name}' is not played: {error}")
                continue
            played_as = renamed.get(name, name)
            self.publishers[name] = session.node.create_publisher(kind, played_as, _qos(bag.topics[name]))
        first = bag.span[0] if bag.span else 0
        self._start = first + round(options.start_offset * 1e9)
        self._clock = session.node.create_publisher(Clock, "/clock", 10) if options.clock > 0 else None
        self._clock_period = 1 / options.clock if options.clock > 0 else float("inf")

    def await_subscribers(self) -> None:
        """Spin until every subscriber that the graph knows of is matched."""
        node, publishers = self._session.node, self.publishers.values()
        self._session.settle(lambda: [node.count_subscribers(p.topic_name) for p in publishers])
        self._session.until(
            lambda: all(p.get_subscription_count() >= node.count_subscribers(p.topic_name) for p in publishers),
            MATCH_LIMIT,
        )

    def play(self) -> int:
        """Play the bag once, and return how many messages there were."""
        begun, count = time.monotonic(), 0
        next_clock = begun if self._clock is not None else float("inf")
        for message in self._messages():
            due = begun + (message.stamp - self._start) / 1e9 / self._rate
            while True:
                now = time.monotonic()
                if now >= next_clock and self._clock is not None:
                    elapsed = round((now - begun) * self._rate * 1e9)
                    # Never past a message that is late.
                    self._clock.publish(clock_to_msg(min(self._start + elapsed, message.stamp)))
                    next_clock = now + self._clock_period
                if now >= due:
                    break
                time.sleep(min(due, next_clock) - now)
            self.publishers[message.topic].publish(message.data)
            count += 1
        return count

    def _messages(self) -> Iterator[BagMessage]:
        return (m for m in self._bag.messages(self.publishers) if m.stamp >= self._start)


def _rename(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(":=")
    if not (old and separator and new):
        raise CommandError(f"--remap '{text}' must be OLD:=NEW")
    return full_name(old), full_name(new)


def _qos(topic: TopicInfo) -> QoSProfile:
    offered = topic.qos[0] if topic.qos else {}
    return make_qos(
        DEPTH,
        reliable=offered.get("reliability", "reliable") != "best_effort",
        latched=offered.get("durability") == "transient_local",
    )


def play(options: argparse.Namespace) -> int:
    """Play a bag."""
    check_rate(options.rate)
    bag = open_bag(options.bag_path)
    with Session(options) as session:
        player = Player(session, bag, options)
        player.await_subscribers()
        session.spin_for(options.delay)
        count = player.play()
        while options.loop:
            if count == 0:
                raise CommandError(f"nothing to play in a loop: no message of {bag.path} is wanted")
            count = player.play()
        if options.wait_for_all_acked >= 0:
            # Subscribers would miss what they have not received when the publishers vanish. To rclpy, -1 is for ever.
            limit = Duration(seconds=options.wait_for_all_acked / 1000 or -1)
            for publisher in player.publishers.values():
                publisher.wait_for_all_acked(limit)
    return 0
