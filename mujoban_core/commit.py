"""Which commit of this project runs."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Final

DIRTY: Final = "-dirty"
"""Follows a commit that code, options or weights have been changed since."""
_COMMANDS: Final = (
    ("ls-files", "--error-unmatch"),
    ("rev-parse", "--verify", "HEAD"),
    # Results and reports are written into docs while they are made, by code that stays what it was.
    ("status", "--porcelain", "--untracked-files=no", "--", ":(top)", ":(top,exclude)docs"),
)
_found: dict[Path, str] = {}
"""What has been asked for before, by file: the code of a process stays as it is."""


def commit_of(file: Path) -> str | None:
    """Return the commit of a file of this code, with `DIRTY` where files in its repository differ from it.

    None where it is in no repository, or lies in one of something else.
    """
    if file in _found:
        return _found[file]
    said: list[str] = []
    for command in _COMMANDS:
        own = (file.name,) if command is _COMMANDS[0] else ()
        try:
            ran = subprocess.run(
                ["git", "--no-optional-locks", *command, *own],
                cwd=file.parent, capture_output=True, text=True, timeout=10, check=True,
            )  # fmt: skip
        except (OSError, subprocess.SubprocessError):
            return None
        said.append(ran.stdout.strip())
    _, commit, changed = said
    _found[file] = f"{commit}{DIRTY if changed else ''}"
    return _found[file]
