"""Entry point of `ros2`: hands over to the genuine command where that is installed, else parses and runs a verb."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from mujoban_core.signals import interrupt_status, interruptible

FAILURE = 1
"""Exit status of a verb that could not do what it was asked for; the arguments' own errors have 2."""
FAMILIES = ("bag", "interface", "node", "param", "service", "topic")
INTERRUPTED = 2
"""Exit status after Ctrl-C, as of the genuine command: the signal's number."""
PACKAGE = "mujoban_msgs"
_ELSEWHERE = "ROS 2 itself has more, such as launch and run; nodes start without: docs/graph.md#run-nodes-on-their-own"


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        Exit status: 0, 1 after one line on stderr about bad input, 2 after one about the arguments or after Ctrl-C,
        143 after SIGTERM.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    # Where rosbag2 is missing, bags are read and written here.
    has_verbs = not arguments or arguments[0] != "bag" or importlib.util.find_spec("ros2bag") is not None
    if importlib.util.find_spec("ros2cli") is not None and has_verbs:
        from ros2cli.cli import main as genuine  # pyright: ignore[reportMissingImports]

        return genuine(argv=arguments)
    other = other_command(os.environ.get("PATH", ""), Path(sys.argv[0]))
    if other is not None and is_prepared(os.environ.get("AMENT_PREFIX_PATH", ""), arguments):
        os.execve(other, [str(other), *arguments], environment_outside(dict(os.environ), Path(sys.prefix)))
    with interruptible():
        return run(arguments)


def other_command(path: str, own: Path) -> Path | None:
    """Return the first `ros2` on a search path that is not a copy of this one."""
    for folder in path.split(os.pathsep):
        candidate = Path(folder or ".") / "ros2"
        if not (candidate.is_file() and os.access(candidate, os.X_OK)):
            continue
        is_own = own.exists() and candidate.samefile(own)
        if not is_own and b"mujoban_msgs_py.ros2" not in candidate.read_bytes():
            return candidate
    return None


def is_prepared(prefixes: str, arguments: Sequence[str]) -> bool:
    """Return whether the ROS 2 of AMENT_PREFIX_PATH knows our messages, and bags if these are asked for."""
    needed = {PACKAGE} | ({"ros2bag"} if arguments and arguments[0] == "bag" else set())
    folders = [Path(p, "share/ament_index/resource_index/packages") for p in prefixes.split(os.pathsep) if p]
    return all(any((folder / package).exists() for folder in folders) for package in needed)


def environment_outside(environment: dict[str, str], prefix: Path) -> dict[str, str]:
    """Return an environment without what the ROS wheels added to it for programs below `prefix`."""
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    folders = [f for f in environment.pop("LD_LIBRARY_PATH", "").split(os.pathsep) if f]
    kept = [f for f in folders if not Path(f).resolve().is_relative_to(prefix.resolve())]
    if kept:
        environment["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
    return environment


def run(arguments: Sequence[str]) -> int:
    """Parse the arguments and run the verb; returns the exit status."""
    # Message fields are typed in by hand here, and unchecked ones of the wrong type would be corrupted silently.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    from mujoban_msgs_py.runtime.discovery import confine_discovery

    confine_discovery()
    family = next(iter(arguments), "")
    parser = make_parser(family)
    if not family.startswith("-") and family not in ("", *FAMILIES):
        parser.error(f"no command {family!r} here, expected one of {', '.join(FAMILIES)}. {_ELSEWHERE}")
    options = parser.parse_args(arguments)
    try:
        status = options.run(options)
        sys.stdout.flush()
        return status
    except (ValueError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            # The reader of a pipe has left, as in `ros2 topic echo /pose | head`.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        print(f"ros2: error: {' '.join(str(error).split())}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt as error:
        status = interrupt_status(error)
        return INTERRUPTED if status == 128 + signal.SIGINT else status


def make_parser(family: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of all verbs, or of those of one family, which takes less time to import."""
    parser = argparse.ArgumentParser(
        prog="ros2", description="The most used commands of ROS 2, where it is not installed.", epilog=_ELSEWHERE
    )
    commands = parser.add_subparsers(title="Commands", metavar="command", required=True)
    for name in [family] if family in FAMILIES else FAMILIES:
        importlib.import_module(f"mujoban_msgs_py.ros2.{name}").add_verbs(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
