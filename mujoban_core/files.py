"""Files: written such that a crash loses nothing, and known by their digest."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DEVICES = (Path("/dev"), Path("/proc"))


_UNFINISHED = ".unfinished"
_DIGITS = 16
LOCK = "lock"
"""Name of the file in a folder by which a process keeps others out."""


class InUseError(ValueError):
    """Another process is at work in a folder."""


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder; the system lets them in again however this one ends.

    Raises:
        InUseError: If another process is at work there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            what = "another process is at work here, expected that it has ended, or another directory"
            raise InUseError(f"{folder}: {what}") from None
        yield


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a place to write a file, which replaces `path` at the end; a crash leaves the old or the new one."""
    path = path.resolve()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        _put(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_alone(path: Path) -> Iterator[Path]:
    """Give a place as `replacing` does, of a folder that only one process writes to.

    What a process that was killed had begun to write there is removed first: large files would fill the disk.
    """
    path = path.resolve()
    folder = path.parent / _UNFINISHED
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder / path.name
        _put(folder / path.name, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _put(temporary: Path, path: Path) -> None:
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    temporary.replace(path)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file such that a crash leaves either the old or the new content.

    A device or a pipe is written to, and never replaced.

    Raises:
        OSError: If it cannot be written; the error names the file.
    """
    with naming(path):
        if is_device(path):
            with path.open("wb") as file:
                file.write(data)
        else:
            with replacing(path) as temporary:
                temporary.write_bytes(data)


def is_device(path: Path) -> bool:
    """Return whether a path is of no file or folder, but of a device or a pipe, as /dev/null and /dev/stdout are."""
    special = path.exists() and not path.is_file() and not path.is_dir()
    return special or any(path.absolute().is_relative_to(folder) for folder in _DEVICES)


def digest(path: str | Path) -> str:
    """Return the SHA-256, in hexadecimal, of a file, or of the names and contents of all files in a folder."""
    path = Path(path)
    total = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        if file != path:
            total.update(file.relative_to(path).as_posix().encode() + b"\0")
        with file.open("rb") as stream:
            hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()


def brief(sha256: str) -> str:
    """Return the beginning of a digest, enough to tell files apart, for texts that people read."""
    return sha256[:_DIGITS]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the file in an error of the system that does not, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename == str(path):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


def check_file(option: str, path: Path | None) -> None:
    """Check that a file can be written, before the work that it is to take; the file stays as it is.

    Args:
        option: What the user has named it by.
        path: The file; None: there is none to check.

    Raises:
        ValueError: If it is a folder, there is none for it, or it is the record of weights, which are none without it.
        OSError: If it may not be written.
    """
    if path is None or is_device(path):
        return
    if path.is_dir():
        raise ValueError(f"{option} {path}: is a folder, expected the name of a file")
    if path.suffix == ".json" and path.is_file() and (weights := path.with_suffix(".safetensors")).is_file():
        raise ValueError(f"{option} {path}: is the record of {weights.name} beside it, expected another name")
    folder = path.resolve().parent
    if not folder.is_dir():
        raise ValueError(f"{option} {path}: no such folder {folder}, expected one that exists")
    _check_room(option, path, folder)


def check_folder(option: str, path: Path | None, *, may_exist: bool = False) -> None:
    """Check that a new folder can be made, with those above it; see `check_file`.

    Args:
        option: Which names it.
        path: The folder; None is fine.
        may_exist: Whether it may be there already, empty.

    Raises:
        ValueError: If not.
    """
    if path is None:
        return
    if path.exists() and not path.is_dir():
        raise ValueError(f"{option} {path}: is a file, expected a new folder")
    if path.exists() and not may_exist:
        raise ValueError(f"{option} {path}: exists, expected a new folder")
    if path.exists() and any(path.iterdir()):
        raise ValueError(f"{option} {path}: is not empty, expected a new folder")
    above = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    _check_room(option, path, above)


def _check_room(option: str, path: Path, folder: Path) -> None:
    """Check that a file can be made in a folder; permissions do not tell, for root and on read-only disks."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b" ")
    except OSError as error:
        why = os.strerror(error.errno or 0)
        raise ValueError(f"{option} {path}: {why}, expected a place that can be written to") from error
