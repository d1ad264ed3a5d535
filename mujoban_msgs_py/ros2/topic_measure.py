"""`ros2 topic hz|bw|delay`: statistics of a topic, printed every second."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from mujoban_msgs_py.raw import raw_stamp
from mujoban_msgs_py.ros2.session import (
    CommandError,
    Session,
    add_discovery_options,
    full_name,
    import_type,
    make_qos,
)
from mujoban_msgs_py.ros2.verbs import Verbs

WINDOW: Final = 10_000
"""Messages over which hz and delay are taken by default."""
BANDWIDTH_WINDOW: Final = 100
"""Messages over which the bandwidth is taken by default."""


def add_verbs(verbs: Verbs) -> None:
    """Add the verbs to the parser."""
    for name, text, window, run in (
        ("hz", "Print the average publishing rate to screen", WINDOW, measure_rate),
        ("bw", "Display bandwidth used by topic", BANDWIDTH_WINDOW, measure_bandwidth),
        ("delay", "Display delay of topic from timestamp in header", WINDOW, measure_delay),
    ):
        parser = verbs.add_parser(name, help=text)
        parser.add_argument("topic_name")
        parser.add_argument("-w", "--window", type=int, default=window, help="Messages over which it is taken")
        if name == "hz":
            parser.add_argument("--wall-time", action="store_true", help="Accepted for compatibility: it always is")
        if name == "delay":
            parser.add_argument("-s", "--use-sim-time", action="store_true", help="Compare with the time on /clock")
        add_discovery_options(parser)
        parser.set_defaults(run=run)


class Window:
    """The latest numbers."""

    def __init__(self, size: int) -> None:
        """Remember at most `size` of them."""
        self._numbers: deque[float] = deque(maxlen=size)
        self.fresh = False

    def add(self, number: float) -> None:
        """Note a number."""
        self._numbers.append(number)
        self.fresh = True

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def mean(self) -> float:
        """Their mean."""
        return sum(self._numbers) / len(self._numbers)

    def __str__(self) -> str:
        mean = self.mean
        deviation = math.sqrt(sum((x - mean) ** 2 for x in self._numbers) / len(self))
        least, most = min(self._numbers), max(self._numbers)
        return f"\tmin: {least:.3f}s max: {most:.3f}s std dev: {deviation:.5f}s window: {len(self)}"


class Bandwidth:
    """Sizes of the latest messages and when they arrived."""

    def __init__(self, size: int) -> None:
        """Remember at most `size` messages."""
        self._arrived: deque[tuple[float, int]] = deque(maxlen=size)

    def add(self, moment: float, size: int) -> None:
        """Note a message of so many bytes that arrived at a moment in seconds."""
        self._arrived.append((moment, size))

    def __len__(self) -> int:
        return len(self._arrived)

    def text(self, now: float) -> str:
        """Return the statistics at a moment in seconds."""
        sizes = [size for _, size in self._arrived]
        numbers = [sum(sizes) / max(now - self._arrived[0][0], 1e-9), sum(sizes) / len(sizes), min(sizes), max(sizes)]
        unit, scale, digits = next(u for u in _UNITS if numbers[0] < 1000 * u[1] or u is _UNITS[-1])
        rate, mean, least, most = (f"{number / scale:.{digits}f} {unit}" for number in numbers)
        return f"{rate}/s from {len(sizes)} messages\n\tMessage size mean: {mean} min: {least} max: {most}"


_UNITS: Final = (("B", 1, 0), ("KB", 1_000, 2), ("MB", 1_000_000, 2))


def _watch(
    options: argparse.Namespace,
    note: Callable[[Session, bytes], None],
    tell: Callable[[], None],
    *,
    stamped: bool = False,
) -> int:
    """Note every message of a topic and tell about them every second, until interrupted."""
    if options.window < 1:
        raise CommandError(f"--window must be a positive integer, got {options.window}")
    topic = full_name(options.topic_name)
    with Session(options, sim_time=getattr(options, "use_sim_time", False)) as session:
        try:
            name = session.topic_type(topic, f"topic [{topic}] does not appear to be published yet")
        except CommandError as missing:
            print(f"WARNING: {missing}", file=sys.stderr)
            session.until(lambda: topic in dict(session.node.get_topic_names_and_types()), None)
            name = session.topic_type(topic)
        kind = import_type(name, "msg")
        if stamped and not hasattr(kind, "header"):
            raise CommandError("msg does not have header")
        receive = make_qos(10, reliable=False)

        def hear(data: Any) -> None:
            note(session, data)

        session.node.create_subscription(kind, topic, hear, receive, raw=True)
        while True:
            session.spin_for(1.0)
            tell()


def measure_rate(options: argparse.Namespace) -> int:
    """Print the rate of a topic every second."""
    intervals, last = Window(max(options.window, 1)), [0.0]

    def note(_: Session, data: bytes) -> None:
        now = time.perf_counter()
        if last[0]:
            intervals.add(now - last[0])
        last[0] = now

    def tell() -> None:
        if intervals.fresh:
            intervals.fresh = False
            print(f"average rate: {1 / intervals.mean if intervals.mean > 0 else 0:.3f}\n{intervals}", flush=True)

    return _watch(options, note, tell)


def measure_bandwidth(options: argparse.Namespace) -> int:
    """Print the bandwidth of a topic every second."""
    bandwidth = Bandwidth(max(options.window, 1))

    def tell() -> None:
        if len(bandwidth):
            print(bandwidth.text(time.perf_counter()), flush=True)

    print(f"Subscribed to [{full_name(options.topic_name)}]", flush=True)
    return _watch(options, lambda _, data: bandwidth.add(time.perf_counter(), len(data)), tell)


def measure_delay(options: argparse.Namespace) -> int:
    """Print every second how long after their stamps messages arrive."""
    delays = Window(max(options.window, 1))

    def note(session: Session, data: bytes) -> None:
        delays.add((session.node.get_clock().now().nanoseconds - raw_stamp(data)) / 1e9)

    def tell() -> None:
        if delays.fresh:
            delays.fresh = False
            print(f"average delay: {delays.mean:.3f}\n{delays}", flush=True)

    return _watch(options, note, tell, stamped=True)
