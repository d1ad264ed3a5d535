"""`ros2 bag info|reindex`; `record` and `play` have files of their own."""

from __future__ import annotations

import argparse
import shutil
import sys
from datetime import datetime
from pathlib import Path
from typing import Final

from mujoban_msgs_py.bags import open_bag, recover_bag
from mujoban_msgs_py.bags.recovery import PARTIAL, REPLACED
from mujoban_msgs_py.ros2 import bag_play, bag_record
from mujoban_msgs_py.ros2.session import CommandError
from mujoban_msgs_py.ros2.verbs import Verbs

_UNITS: Final = ("B", "KiB", "MiB", "GiB", "TiB")
_INDENT: Final = " " * 19


def add_verbs(commands: Verbs) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("bag", help="Various rosbag related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    parser = verbs.add_parser("info", help="Print information about a bag to the screen")
    parser.add_argument("bag_path", help="Bag to open")
    parser.add_argument("-t", "--topic-name", action="store_true", help="Only display topic names")
    parser.set_defaults(run=show_info)
    bag_play.add_verb(verbs)
    bag_record.add_verb(verbs)
    parser = verbs.add_parser("reindex", help="Make a bag whole again, and keep the old one as NAME.damaged")
    parser.add_argument("bag_path", help="Bag to reindex")
    parser.set_defaults(run=reindex)


def show_info(options: argparse.Namespace) -> int:
    """Print what is in a bag; damage is named on stderr."""
    bag = open_bag(options.bag_path, damaged="skip")
    topics = sorted(bag.topics.values(), key=lambda topic: topic.name)
    for text in bag.skipped:
        print(f"warning: {text}", file=sys.stderr)
    if options.topic_name:
        for topic in topics:
            print(topic.name)
        return 0
    start, end = bag.span or (0, 0)
    lines = [f"Topic: {t.name} | Type: {t.type_name} | Count: {t.count} | Serialization Format: cdr" for t in topics]
    files = [path for path in bag.files if path.is_file()] or sorted(Path(options.bag_path).glob("*.db3"))
    print()
    print("Files:            ", f"\n{_INDENT}".join(path.name for path in files))
    print("Bag size:         ", _size(sum(path.stat().st_size for path in files)))
    print("Storage id:       ", "sqlite3" if any(path.suffix == ".db3" for path in files) else "mcap")
    print("ROS Distro:       ", bag.distribution or "unknown")
    print("Duration:         ", f"{_seconds(end - start)}s")
    print("Start:            ", _moment(start))
    print("End:              ", _moment(end))
    print("Messages:         ", sum(topic.count for topic in topics))
    print("Topic information:", f"\n{_INDENT}".join(lines))
    print()
    return 0


def reindex(options: argparse.Namespace) -> int:
    """Put all that is whole of a bag in its place, and keep the bag under another name.

    Raises:
        CommandError: If there is something of that name.
    """
    path = Path(options.bag_path)
    partial, replaced = path.with_name(path.name + PARTIAL), path.with_name(path.name + REPLACED)
    if partial.exists() and replaced.exists() and not path.exists():
        partial.rename(path)  # all that a command which was killed had left to do
        return 0
    if replaced.exists():
        raise CommandError(f"{replaced} exists already: expected that name to be free, for the bag as it was")
    shutil.rmtree(partial, ignore_errors=True)
    skipped = recover_bag(path, partial)
    path.rename(replaced)
    partial.rename(path)
    for text in skipped:
        print(f"warning: {text}", file=sys.stderr)
    print(f"Reindexing complete; the bag as it was is {replaced}.")
    return 0


def _size(count: int) -> str:
    size, unit = float(count), 0
    while size >= 1024 and unit < len(_UNITS) - 1:
        size, unit = size / 1024, unit + 1
    return f"{size:.{1 if unit else 0}f} {_UNITS[unit]}"


def _seconds(nanoseconds: int) -> str:
    return f"{nanoseconds // 1_000_000_000}.{nanoseconds // 1_000_000 % 1000:03d}"


def _moment(stamp: int) -> str:
    local = datetime.fromtimestamp(stamp // 1_000_000_000)
    date = f"{local:%b} {local.day:2d} {local:%Y %H:%M:%S}"
    return f"{date}.{stamp // 1_000_000 % 1000:03d} ({_seconds(stamp)})"
