"""`ros2 interface show|list|package`."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from mujoban_msgs_py.bags.types import MESSAGES, PACKAGE
from mujoban_msgs_py.ros2.session import CommandError
from mujoban_msgs_py.ros2.verbs import Verbs

KINDS: Final = {"msg": "Messages", "srv": "Services", "action": "Actions"}
_FIELD: Final = re.compile(r"^\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[a-z]\w*")
_PRIMITIVES: Final = re.compile(r"^(bool|byte|char|w?string|float(32|64)|u?int(8|16|32|64))$")


def add_verbs(commands: Verbs) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("interface", help="Show information about ROS interfaces")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    parser = verbs.add_parser("list", help="List all interface types available")
    for kind, title in KINDS.items():
        text = f"Print out only {title.lower()}"
        parser.add_argument(f"-{kind[0]}", f"--only-{kind}s", action="store_true", help=text)
    parser.set_defaults(run=list_interfaces)
    parser = verbs.add_parser("package", help="Output a list of available interface types within one package")
    parser.add_argument("package_name", help="Name of the ROS package (e.g. 'example_interfaces')")
    parser.set_defaults(run=list_package)
    parser = verbs.add_parser("show", help="Output the interface definition")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--all-comments", action="store_true", help="Show all comments, also of nested interfaces")
    group.add_argument("--no-comments", action="store_true", help="Show no comments or whitespace")
    parser.add_argument("type", help="Interface to show (e.g. 'std_msgs/msg/String'); '-' reads it from stdin")
    parser.set_defaults(run=show)


def folders() -> dict[str, Path]:
    """Return where the interfaces of each package lie: of this repository, this environment, and AMENT_PREFIX_PATH."""
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    found = {PACKAGE: MESSAGES.parent}
    for prefix in prefixes:
        for marker in Path(prefix, "share/ament_index/resource_index/rosidl_interfaces").glob("*"):
            found.setdefault(marker.name, Path(prefix, "share", marker.name))
    return found


def interfaces(folder: Path, kind: str) -> list[str]:
    """Return the names of a package's interfaces of a kind."""
    return sorted(path.stem for path in (folder / kind).glob(f"*.{kind}"))


def list_interfaces(options: argparse.Namespace) -> int:
    """Print the interfaces of all packages, by kind."""
    wanted = [kind for kind in KINDS if getattr(options, f"only_{kind}s")] or list(KINDS)
    for kind in wanted:
        print(f"{KINDS[kind]}:")
        for package, folder in sorted(folders().items()):
            for name in interfaces(folder, kind):
                print(f"    {package}/{kind}/{name}")
    return 0


def list_package(options: argparse.Namespace) -> int:
    """Print the interfaces of a package."""
    folder = folders().get(options.package_name)
    if folder is None:
        raise CommandError(f"Unknown package '{options.package_name}'")
    for kind in KINDS:
        for name in interfaces(folder, kind):
            print(f"{options.package_name}/{kind}/{name}")
    return 0


def show(options: argparse.Namespace) -> int:
    """Print the definition of an interface, with those of its fields below them."""
    name = sys.stdin.readline().strip() if options.type == "-" else options.type
    for line in definition(name, comments=not options.no_comments, nested_comments=options.all_comments):
        print(line)
    return 0


def definition(name: str, *, comments: bool, nested_comments: bool, depth: int = 0) -> Iterator[str]:
    """Yield the lines of an interface's definition, each field's type expanded below it.

    Args:
        name: Such as `std_msgs/msg/Header`.
        comments: Whether comments and empty lines are among them.
        nested_comments: Whether those of the types below are.
        depth: Tabs before each line.

    Raises:
        CommandError: If there is no such interface.
    """
    parts = name.split("/")
    if len(parts) != 3:
        raise CommandError(f"Invalid name '{name}'. Expected three parts separated by '/'")
    package, kind, base = parts
    path = folders().get(package, Path()) / kind / f"{base}.{kind}"
    if not path.is_file():
        raise CommandError(f"Could not find the interface '{name}'")
    for text in map(str.rstrip, path.read_text().splitlines()):
        code = text.partition("#")[0].rstrip()
        if comments or code:
            shown = text if comments else code
            yield "\t" * depth + shown if shown else ""
        field = _FIELD.match(code)
        if field and not _PRIMITIVES.match(field["type"]):
            used = field["type"] if "/" in field["type"] else f"{package}/{field['type']}"
            below = used if used.count("/") == 2 else used.replace("/", "/msg/")
            yield from definition(below, comments=nested_comments, nested_comments=nested_comments, depth=depth + 1)
