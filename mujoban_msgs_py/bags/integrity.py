"""What tells whether a bag is whole: who its files are, their checksums, and what metadata.yaml says of them."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import McapError
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader

from mujoban_core.files import digest, naming
from mujoban_msgs_py.bags.errors import BagError

IDENTITY: Final = "mujoban_bag"
"""Name of the MCAP metadata record that says which file of which bag a file is; the first record of the file."""
LAST: Final = "mujoban_last_file"
"""Name of the MCAP metadata record in the last file of a bag that was closed."""
_ABOUT: Final = "mujoban/"
"""Beginning of the keys of what was recorded."""
_BLOCK: Final = 1 << 20


class Identity(NamedTuple):
    """Which file of which bag a file is."""

    bag: str
    """A number that no other bag has."""
    index: int
    """From 0."""
    about: Mapping[str, str]
    """What was recorded, as `Metadata.about`: a file may be all that is left of a bag."""


class Reserve:
    """Room on a disk, held by a file without a name until the disk is full: then what was begun can be finished.

    Attributes:
        full: The error of the disk when it was full, or None.
    """

    def __init__(self, folder: Path, size: int) -> None:
        """Hold so many bytes.

        Raises:
            OSError: If there are not as many.
        """
        self.full: OSError | None = None
        with naming(folder):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # held for as long as the bag is open
            os.posix_fallocate(self._file.fileno(), 0, size)

    def released(self, error: OSError) -> bool:
        """Give the room free if an error says that the disk is full; return whether it was held until now."""
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or self.full is not None:
            return False
        self.full = error
        self.close()
        return True

    def close(self) -> None:
        """Give the room free."""
        self._file.close()


class HashedFile:
    """A new file that knows its SHA-256; what is written has left the process, should it be killed."""

    def __init__(self, path: Path, reserve: Reserve) -> None:
        """Make the file; `reserve` is used up where the disk is full."""
        self._reserve = reserve
        self._file = path.open("xb", buffering=0)
        self._hash = hashlib.sha256()

    def flush(self) -> None:
        """Do nothing: nothing is held back."""

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self._file.tell()

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Write all of `data`."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view):
            try:
                done += self._file.write(view[done:]) or 0
            except OSError as error:
                if not self._reserve.released(error):
                    raise
        self._hash.update(view)
        return done

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def digest(self) -> str:
        """SHA-256 of what was written so far, in hexadecimal."""
        return self._hash.hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; a file that has not changed since is not read again."""
    status = path.stat()
    return _digest(path, status.st_size, status.st_mtime_ns, status.st_ino)


@lru_cache(maxsize=1024)
def _digest(path: Path, size: int, changed: int, inode: int) -> str:
    del size, changed, inode
    return digest(path)


def require_regular(path: Path) -> None:
    """Refuse what is no file, such as a pipe, which nobody may ever write to.

    Raises:
        BagError: If it is none, or there is nothing.
    """
    if not path.exists():
        raise BagError(f"cannot read {path}: No such file or directory")
    if not path.is_file():
        raise BagError(f"cannot read {path}: it is not a regular file")


def read_identity(path: Path) -> Identity | None:
    """Return which file of which bag an MCAP file is; None where its writer did not say, or it is damaged there."""
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True, record_size_limit=_BLOCK).records:
                if isinstance(record, Metadata) and record.name == IDENTITY:
                    told = record.metadata
                    return Identity(told["bag"], int(told["index"]), load_about(told))
                if isinstance(record, Chunk):
                    return None
    except (McapError, ValueError, KeyError, EOFError, OSError, RuntimeError):
        return None
    return None


def check_family(identities: dict[Path, Identity | None], complain: Callable[[str], None], *, last: bool) -> list[Path]:
    """Return the files that belong together, in order; for a bag without metadata.yaml.

    Args:
        identities: Of the files that are there, in order.
        complain: Told what is wrong, in words.
        last: Whether the last of them says that it is the bag's last.
    """
    known = {path: identity for path, identity in identities.items() if identity is not None}
    if not known:
        return list(identities)
    own = next(iter(known.values())).bag
    kept: dict[int, Path] = {}
    for path, identity in identities.items():
        if identity is None or identity.bag != own:
            complain(f"{path.name} is of another bag than {next(iter(known)).name}")
        elif identity.index in kept:
            complain(f"{path.name} is the same file as {kept[identity.index].name}")
        else:
            kept[identity.index] = path
    missing = sorted(set(range(max(kept) + 1)) - kept.keys())
    if missing:
        complain(f"it lacks file number {', '.join(map(str, missing))}")
    if not last:
        complain("it has no metadata.yaml and its last file does not say that it is the last: files may be missing")
    return [kept[index] for index in sorted(kept)]


def dump_identity(identity: Identity) -> dict[str, str]:
    """Return the content of the `IDENTITY` record."""
    return {"bag": identity.bag, "index": str(identity.index), **dump_about(identity.about)}


def dump_about(about: Mapping[str, str]) -> dict[str, str]:
    """Return what was recorded by the keys under which metadata.yaml and the files carry it."""
    return {_ABOUT + name: value for name, value in about.items()}


def load_about(told: Mapping[str, str]) -> dict[str, str]:
    """Return what was recorded from what metadata.yaml or a file carries."""
    return {key.removeprefix(_ABOUT): value for key, value in told.items() if key.startswith(_ABOUT)}
