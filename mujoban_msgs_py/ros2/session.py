"""A node of the command's own, waiting for the graph, and what verbs ask of it."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import rclpy
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from mujoban_msgs_py.runtime.discovery import held_domains, is_alone
from mujoban_msgs_py.runtime.tick_node import ros_context

DISCOVERY_LIMIT: Final = 5.0
"""Seconds within which what exists has been discovered."""
QUIET_TIME: Final = 0.7
"""Seconds without a change after which the graph counts as discovered."""
STEP: Final = 0.05
"""Seconds for which the executor may wait without looking at interruptions."""


FoundT = TypeVar("FoundT")


class CommandError(ValueError):
    """A command was asked for something that cannot be done; the message is one line."""


class Session:
    """A hidden node that is spun as long as a verb needs it."""

    def __init__(self, options: argparse.Namespace, *, sim_time: bool = False) -> None:
        """Remember how long to wait for discovery.

        Args:
            options: Parsed options; `spin_time` is how long to look around, None for as long as it takes.
            sim_time: Whether the node's clock follows /clock.
        """
        self._spin_time: float | None = getattr(options, "spin_time", None)
        self._sim_time = sim_time

    def __enter__(self) -> Self:
        with ExitStack() as exits:
            self._enter(exits)
            self._exits = exits.pop_all()
        return self

    def _enter(self, exits: ExitStack) -> None:
        context = rclpy.Context()
        exits.enter_context(ros_context([], context))
        overrides = [Parameter("use_sim_time", value=True)] if self._sim_time else []
        name = f"_ros2cli_{os.getpid()}"
        self.node = rclpy.create_node(
            name,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=overrides,
        )
        self.executor: Executor = EventsExecutor(context=context)
        self.executor.add_node(self.node)
        exits.callback(self.node.destroy_node)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exits.__exit__(kind, error, trace)

    def until(self, done: Callable[[], bool], timeout: float | None = DISCOVERY_LIMIT) -> bool:
        """Spin until `done` or for `timeout` seconds (None: for ever); returns whether it is done."""
        end = None if timeout is None else time.monotonic() + timeout
        while not done():
            rest = STEP if end is None else min(STEP, end - time.monotonic())
            if rest <= 0:
                return False
            self.executor.spin_once(timeout_sec=rest)
        return True

    def spin_for(self, seconds: float) -> None:
        """Spin for some time."""
        self.until(lambda: False, seconds)

    def settle(self, graph: Callable[[], FoundT]) -> FoundT:
        """Return what `graph` says once others are there and it has stopped changing, or after `--spin-time`.

        Where no others can be there it says so at once, and nobody is waited for.
        """
        if self._spin_time is not None:
            self.spin_for(self._spin_time)
            return graph()
        patience = _patience()
        end = time.monotonic() + DISCOVERY_LIMIT * patience
        seen, since = graph(), time.monotonic()
        while time.monotonic() < end:
            if is_alone(self.domain):
                print(f"warning: {self._lonely()}", file=sys.stderr)
                return graph()
            known = self._others_known()
            if known and time.monotonic() >= since + QUIET_TIME * patience:
                return seen
            self.spin_for(STEP)
            now = graph()
            if now != seen or not known:
                seen, since = now, time.monotonic()
        if self._others():
            print(f"warning: still discovering after {DISCOVERY_LIMIT * patience:.0f} s: this may not be all of it; "
                  "--spin-time looks longer", file=sys.stderr)  # fmt: skip
        return seen

    @property
    def domain(self) -> int:
        """The ROS domain."""
        return self.node.context.get_domain_id()

    def _lonely(self) -> str:
        elsewhere = [str(domain) for domain in held_domains() if domain != self.domain]
        there = f", but graphs run in {', '.join(elsewhere)}" if elsewhere else ""
        return f"nobody else is in ROS domain {self.domain} of this machine{there} (ROS_DOMAIN_ID)"

    @property
    def limit(self) -> float:
        """Seconds within which what exists has to be discovered."""
        return DISCOVERY_LIMIT * _patience() if self._spin_time is None else self._spin_time

    def _others(self) -> list[tuple[str, str]]:
        """Return name and namespace of all other nodes that have been discovered."""
        names = self.node.get_node_names_and_namespaces()
        return [(name, namespace) for name, namespace in names if name != self.node.get_name()]

    def _others_known(self) -> bool:
        """Return whether others have been discovered, and of each of them something that it publishes or serves.

        A node's name arrives before its topics and services, and on a busy machine long before.
        """
        others = self._others()
        try:
            return bool(others) and all(
                self.node.get_publisher_names_and_types_by_node(*other)
                or self.node.get_service_names_and_types_by_node(*other)
                for other in others
            )
        except RuntimeError:  # one of them has gone in between
            return False

    def wait_for(self, found: Callable[[], bool], complaint: str) -> None:
        """Spin until something has been discovered.

        Raises:
            CommandError: With `complaint` if it is not within the time for discovery.
        """
        if not self.until(found, self.limit):
            raise CommandError(f"{complaint}; {self._lonely()}" if is_alone(self.domain) else complaint)

    def topic_type(self, topic: str, complaint: str | None = None) -> str:
        """Return the type of a topic once it has been discovered.

        Raises:
            CommandError: If there is no such topic.
        """
        self.wait_for(
            lambda: topic in dict(self.node.get_topic_names_and_types()), complaint or f"unknown topic '{topic}'"
        )
        return dict(self.node.get_topic_names_and_types())[topic][0]


def _patience() -> float:
    """Return by how much all takes longer on a machine that has more to do than it has cores, at most 6."""
    return min(6.0, max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)))


def full_name(name: str) -> str:
    """Return a name with its leading slash."""
    return name if name.startswith("/") else f"/{name}"


def is_hidden(name: str) -> bool:
    """Return whether a part of a name begins with an underscore, or a topic belongs to a service."""
    return any(part.startswith("_") for part in name.split("/"))


def import_type(name: str, kind: str) -> type[Any]:
    """Return the class of an interface such as `std_msgs/msg/Header`.

    Raises:
        CommandError: If the name is malformed or there is no such interface.
    """
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    if len(parts) != 3 or parts[1] != kind:
        raise CommandError(f"'{name}' is not a type: expected package/{kind}/Type")
    try:
        return getattr(importlib.import_module(f"{parts[0]}.{kind}"), parts[2])
    except (ImportError, AttributeError):
        raise CommandError(f"the type '{name}' is unknown: no installed package has it") from None


def check_rate(rate: float) -> None:
    """Refuse a rate, as --rate gives it, by which nothing would ever come.

    Raises:
        CommandError: If it is not greater than zero, or no number.
    """
    if not rate > 0:
        raise CommandError(f"--rate must be greater than zero, got {rate}")


def add_discovery_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about discovery that the genuine command has."""
    parser.add_argument(
        "--spin-time", type=float, metavar="SPIN_TIME", help="Seconds to wait for discovery (default: until it settles)"
    )
    parser.add_argument("--no-daemon", action="store_true", help="Accepted for compatibility: there is no daemon")


def add_qos_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about quality of service that the genuine command has."""
    parser.add_argument("--qos-depth", type=int, metavar="N", help="Queue size setting")
    parser.add_argument("--qos-history", choices=["keep_last", "keep_all"], help="History of samples setting")
    parser.add_argument("--qos-reliability", choices=["reliable", "best_effort"], help="Reliability setting")
    parser.add_argument("--qos-durability", choices=["volatile", "transient_local"], help="Durability setting")


def choose_qos(options: argparse.Namespace, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    """Return the profile that the options ask for; what they leave open is `reliable` and `latched`."""
    if options.qos_reliability:
        reliable = options.qos_reliability == "reliable"
    if options.qos_durability:
        latched = options.qos_durability == "transient_local"
    profile = make_qos(options.qos_depth or 10, reliable=reliable, latched=latched)
    if options.qos_history == "keep_all":
        profile.history = HistoryPolicy.KEEP_ALL
    return profile


def make_qos(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    """Return a profile that keeps the last `depth` messages."""
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def qos_of_publishers(session: Session, topic: str) -> tuple[bool, bool]:
    """Return whether all publishers of a topic are reliable, and whether all are latched."""
    profiles = [info.qos_profile for info in session.node.get_publishers_info_by_topic(topic)]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = bool(profiles) and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return reliable, latched
