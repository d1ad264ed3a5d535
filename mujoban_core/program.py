"""What all programs have in common: options by tyro, one line on stderr for bad input, one end for signals.

A program's options are a dataclass; its `main` reads them and is run by `run_command`:

    def main(command_line: Sequence[str] | None = None) -> int:
        options = read_options(Options, command_line, PROG)
        ...

    def run() -> NoReturn:
        run_command(PROG, main)
"""

from __future__ import annotations

import errno
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from pathlib import Path
from typing import Any, Final, NoReturn, TypeVar

from mujoban_core.children import end_with_parent
from mujoban_core.signals import interrupt_status, interruptible, interruption, leave

OptionsT = TypeVar("OptionsT")

_READER_LEFT: Final = 128 + signal.SIGPIPE
"""Exit status of a command whose output nobody reads on, as that of `head` and its like: as if SIGPIPE had ended it."""
USAGE_ERROR: Final = 2
"""Exit status of a command whose input was bad."""
_EXPECTED: Final = {
    errno.EEXIST: "a folder, or a name that is free",
    errno.ENOENT: "one that exists",
    errno.ENOTDIR: "a folder",
    errno.EISDIR: "a file",
    errno.EACCES: "one that may be used",
    errno.EPERM: "one that may be used",
    errno.EROFS: "a place that can be written to",
}
"""What a program expects of a file of which the system says that."""
_OUT_OF_MEMORY: Final = ("allocate memory", "failed to map segment")
"""How MuJoCo, torch and the system's loader of libraries say that there is no memory left."""
_SCRIPTS: Final = "mujoban-"
"""Start of the names of the installed commands."""


def run_command(prog: str, command: Callable[[], int]) -> NoReturn:
    """Run a command and end the process with its `exit_status`."""
    leave(exit_status(called(prog), command))


def called(prog: str) -> str:
    """Return the name that a program was called by: that of its installed command, or its own."""
    name = Path(sys.argv[0]).name
    return name if name.startswith(_SCRIPTS) else prog


def exit_status(prog: str, command: Callable[[], int]) -> int:
    """Run a command and return its exit status.

    Bad input is one line on stderr and status 2; a signal that asks the command to end is status 130 or 143. Where
    nobody reads the output on, as behind `| head`, the command ends without a word.
    """
    end_with_parent()
    try:
        with interruptible():
            return _flushed(command)
    except Exception as error:
        return _failure(prog, error)
    except KeyboardInterrupt as error:
        say(f"{prog}: interrupted")
        return interrupt_status(error)
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR


def _failure(prog: str, error: Exception) -> int:
    """Say in one line what is wrong with the input or the machine, and return the status; raise what is neither."""
    if (earlier := interruption(error)) is not None:
        return interrupt_status(earlier)
    if isinstance(error, BrokenPipeError):
        # Python flushes once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _READER_LEFT
    if isinstance(error, MemoryError) or any(sign in str(error) for sign in _OUT_OF_MEMORY):
        say(f"{prog}: error: out of memory ({reason(error)}), expected more than this process may have")
    elif isinstance(error, (ValueError, OSError)):
        say(f"{prog}: error: {reason(error)}")
    else:
        raise error
    return USAGE_ERROR


def _flushed(command: Callable[[], int]) -> int:
    """Run a command; what it has printed fails here, if it does, and not when the process ends."""
    try:
        return command()
    finally:
        sys.stdout.flush()


def reason(error: Exception) -> str:
    """Return in one line what an error says; of the system's: the file, what is wrong with it, what was expected."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        expected = _EXPECTED.get(error.errno or 0)
        return f"{error.filename}: {error.strerror}" + (f", expected {expected}" if expected else "")
    return " ".join(str(error).split()) or type(error).__name__


def say(line: str) -> None:
    """Print a line on stderr, if that can still be written to: the terminal may have been closed."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


def read_options(
    options: type[OptionsT] | Mapping[str, type[OptionsT]],
    command_line: Sequence[str] | None,
    prog: str,
    description: str | None = None,
) -> OptionsT:
    """Read the options of a command.

    Args:
        options: A dataclass; or, for commands with subcommands, theirs by name.
        command_line: The arguments; None: those of the process.
        prog: Name of the program.
        description: What it does; by default the docstring of `options`.

    Raises:
        ValueError: If an option is unknown or its value is not what is expected.
        SystemExit: If help was asked for.
    """
    import tyro

    if isinstance(options, Mapping):
        _check_subcommand(sys.argv[1:] if command_line is None else command_line, options)
    read: Any = tyro.extras.subcommand_cli_from_dict if isinstance(options, Mapping) else tyro.cli
    with _errors_in_one_line("what --help lists"):
        return read(
            options, args=command_line, prog=prog, description=description, config=(tyro.conf.FlagCreatePairsOff,)
        )


def _check_subcommand(words: Sequence[str], known: Mapping[str, Any]) -> None:
    """Raise a ValueError if what stands in the place of a subcommand is none."""
    if words and not words[0].startswith("-") and words[0] not in known:
        raise ValueError(f"{words[0]}: expected one of {', '.join(known)}")


def read_changes(settings: OptionsT, words: Sequence[str], expected: str) -> OptionsT:
    """Return settings with the options that the value of another option names; `--help` is none of them.

    Args:
        settings: A dataclass; options of those within it need no prefix.
        words: Options with their values.
        expected: What to expect in the place of an option that is unknown and resembles none.

    Raises:
        ValueError: If an option is unknown or its value is not what is expected.
    """
    import tyro

    if printing := [word for word in words if word.startswith("--tyro-")]:  # and ending the process
        raise ValueError(f"unrecognized options: {', '.join(printing)}, expected {expected}")
    with _errors_in_one_line(expected):
        return tyro.cli(
            type(settings), default=settings, args=words, prog="", add_help=False,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        )  # fmt: skip


@contextmanager
def _errors_in_one_line(expected: str) -> Iterator[None]:
    """Raise a ValueError of one line where tyro would say more and end the process.

    Args:
        expected: What to expect where tyro does not say it.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            yield
    except SystemExit as leaving:
        if leaving.code in (0, None):
            raise
        raise ValueError(_one_line(said.getvalue(), expected)) from None


_BOX: Final = re.compile(r"\x1b\[[0-9;]*m|[│╭╮╰╯]")
_RULE: Final = re.compile(r"^(?:─+|-{3,})$", re.MULTILINE)
_CLOSING: Final = "For full helptext"
"""Start of what tyro says last, of a command that has `--help`."""


def _one_line(box: str, expected: str) -> str:
    """Return in one line what tyro says in a box: what is wrong, and what it expects, or else what we do.

    The first row is the box's title; where stdout is not UTF-8, rules are hyphens.
    """
    rows = [_BOX.sub("", row).strip() for row in box.splitlines()][1:]
    parts = _RULE.split("\n".join(row for row in rows if row))
    sections = [part.strip().split("\n") for part in parts if part.strip()]
    wrong = " ".join(sections[0]).removeprefix("Error parsing ")
    if lacking := re.match(r"Missing value for argument '(--\S+)'\. Expected (\d+)", wrong):
        option, count = lacking.groups()
        return f"{option} has " + ("no value, expected one" if count == "1" else f"too few values, expected {count}")
    # How tyro names what a subcommand's options are made of.
    wrong = re.sub(r"^(?:--)?__tyro-dummy-inner__\.(?:\w+\.)*\w+: ", "", wrong)
    # And whose check of all options together it is that failed: that of a class, or of an option.
    wrong = re.sub(r"^(?:[A-Z]\w*: |\w+: (?=--))", "", wrong)
    if "xpected" in wrong:
        return re.sub(r"^(--[\w-]+): ", r"\1 ", wrong[0].lower() + wrong[1:])
    if missing := re.match(r".*[Mm]issing from .*?: (--\S+)", wrong):
        return f"{missing[1]} is missing, expected it with a value"
    told = (part[1:] for part in sections[1:] if not part[0].startswith(_CLOSING))
    known = dict.fromkeys(row for rows in told for row in rows if row.startswith("-"))
    return f"{wrong[0].lower()}{wrong[1:]}, expected {' or '.join(known) or expected}"
