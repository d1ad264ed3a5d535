"""Shared memory: what the processes of a run leave each other there, and what those that were killed left."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Set
from contextlib import suppress
from pathlib import Path
from typing import Final

FOLDER: Final = Path("/dev/shm")
_SEGMENT: Final = re.compile(r"(?:sem\.)?(fastrtps_(?:port\d+|[0-9a-f]{16}))(?:_el|_sl|_mutex)?")
_RUN: Final = "mujoban-run-"
"""Begins the name of a run's folder."""


class RunFolder:
    """A folder of this user for the processes of a run, in memory: what they write in every tick costs no disk.

    It is held by a lock, which ends with this process; `clear_shared_memory` removes those that nobody holds.

    Attributes:
        path: The folder.
    """

    def __init__(self, parent: Path = FOLDER) -> None:
        """Make it in shared memory, or among the temporary files where there is none."""
        if not os.access(parent, os.W_OK | os.X_OK):
            parent = Path(tempfile.gettempdir())
        self._lock = -1
        while self._lock < 0:
            self.path = Path(tempfile.mkdtemp(prefix=_RUN, dir=parent))
            self._lock = _lock(self.path)

    def remove(self) -> None:
        """Remove it with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def _lock(folder: Path) -> int:
    """Return the descriptor that holds a folder until it is closed; -1 if somebody else holds or has removed it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return -1
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(descriptor).st_ino == folder.lstat().st_ino:
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return -1


def clear_shared_memory(folder: Path = FOLDER) -> list[str]:
    """Remove this user's segments and ports of Fast DDS, and runs' folders, that no process holds; return their names.

    A segment in use is held by a lock on the file beside it, which Fast DDS itself goes by (`fastdds shm clean`). It
    may be without that file for a moment; so what any process has open or has mapped is left alone as well.
    """
    groups = _segments(folder)
    # The look at the processes comes after that at the files: whoever has just made one has it open or mapped by now.
    used = _used_names() if groups else set()
    removed = []
    for files in groups.values():
        if used.isdisjoint(file.name for file in files) and not any(map(_is_locked, files)):
            removed += _remove(files)
    for run in filter(_is_own, sorted(folder.glob(f"{_RUN}*"))):
        if (lock := _lock(run)) >= 0:
            shutil.rmtree(run, ignore_errors=True)
            os.close(lock)
            removed.append(run.name)
    return removed


def mapped_segments() -> set[str]:
    """Return the names of the segments and ports of Fast DDS that this process has mapped."""
    names = _SEGMENT.findall(Path("/proc/self/maps").read_text(errors="replace"))
    return set(names)


def release_segments(names: Set[str], folder: Path = FOLDER) -> list[str]:
    """Remove segments and ports that this process holds and no other; return the names of the files.

    For a program that ends with participants which it cannot put away in order, as it was interrupted while it made
    them.
    """
    groups = [files for name, files in _segments(folder).items() if name in names]
    used = _used_names(but=os.getpid()) if groups else set()
    return [name for files in groups if used.isdisjoint(file.name for file in files) for name in _remove(files)]


def _segments(folder: Path) -> dict[str, list[Path]]:
    """Return this user's segments and ports: name -> files."""
    groups: dict[str, list[Path]] = {}
    for file in sorted(folder.glob("*fastrtps_*")):
        match = _SEGMENT.fullmatch(file.name)
        if match is not None and _is_own(file):
            groups.setdefault(match[1], []).append(file)
    return groups


def _remove(files: Iterable[Path]) -> list[str]:
    removed = []
    for file in files:
        file.unlink(missing_ok=True)
        removed.append(file.name)
    return removed


def _is_own(file: Path) -> bool:
    try:
        return file.lstat().st_uid == os.getuid()
    except OSError:  # gone by now
        return False


def _is_locked(file: Path) -> bool:
    if not file.name.endswith(("_el", "_sl")):
        return False
    try:
        with file.open("rb") as opened:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _used_names(but: int = 0) -> set[str]:
    """Return the names of the files in shared memory that any process of this user but one has open, and mapped."""
    names: set[str] = set()
    processes = [entry for entry in Path("/proc").iterdir() if entry.name.isdecimal() and entry.name != str(but)]
    for process in processes:
        try:
            links = list((process / "fd").iterdir())
        except OSError:  # another user's, or ended
            continue
        for link in links:
            with suppress(OSError):  # closed by now
                names.add(os.readlink(link).rpartition("/")[2])
    for process in processes:
        try:
            maps = (process / "maps").read_text(errors="replace")
        except OSError:
            continue
        names.update(line.rpartition("/")[2] for line in maps.splitlines() if "fastrtps_" in line)
    return names
