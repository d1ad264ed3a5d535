"""Read rosbag2 bags: raw messages, NumPy values, or whole ticks."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.integrity import check_family, file_digest, read_identity, require_regular
from mujoban_msgs_py.bags.metadata import FILE_NAME, FileRecord, Metadata
from mujoban_msgs_py.bags.storage import Damage, McapFile, RawMessage, SqliteBag, Storage, TopicInfo
from mujoban_msgs_py.bags.types import TypeRegistry, known_types, types_of_schemas
from mujoban_msgs_py.decoders import DECODERS
from mujoban_msgs_py.synchroniser import Synchroniser
from mujoban_msgs_py.topics import Topic

BagMessage = RawMessage

HELD_TICKS: Final = 64
"""Unfinished ticks kept while ticks are put together: in real time late answers come behind newer observations."""

_DECODER_BY_NAME: Final = {topic.name: (topic, decode) for topic, decode in DECODERS.items()}


class Value(NamedTuple):
    """What a message says."""

    topic: str
    stamp: int
    """Log time in nanoseconds."""
    value: Any
    """As `conversions` returns it for a topic of the graph, else an object with the message's fields."""


class Tick(NamedTuple):
    """What several topics said in one tick."""

    stamp: int
    """Simulated time in nanoseconds."""
    values: tuple[Any, ...]
    """In the order of the topics asked for."""


class Bag:
    """A bag that is open for reading; iterate as often as you like, memory stays bounded.

    Attributes:
        path: The bag.
        about: What its recorder says of it, such as `world` and `body`; empty for those of others.
        distribution: Of the ROS 2 that recorded it; empty where metadata.yaml is missing or does not say.
        incomplete: After `ticks`: messages that found no partner, by topic.
    """

    def __init__(
        self, path: Path, storages: Sequence[Storage], doubts: Sequence[str] = (),
        about: Mapping[str, str] | None = None, distribution: str = "",
    ) -> None:  # fmt: skip
        """Use `open_bag`."""
        self.path, self.about, self.distribution = path, dict(about or {}), distribution
        self._doubts = tuple(doubts)
        self.incomplete: Counter[str] = Counter()
        self._storages = tuple(storages)

    @cached_property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics by name."""
        found: dict[str, TopicInfo] = {}
        for storage in self._storages:
            for info in storage.topics.values():
                known = found.setdefault(info.name, TopicInfo(info.name, info.type_name, 0, info.qos))
                if known.type_name != info.type_name:
                    raise BagError(f"topic {info.name} of {self.path} is of types {known.type_name}, {info.type_name}")
                known.count += info.count
        return found

    @property
    def files(self) -> tuple[Path, ...]:
        """The bag's files."""
        return tuple(storage.path for storage in self._storages)

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time in nanoseconds, or None without messages."""
        spans = [span for storage in self._storages if (span := storage.span) is not None]
        return (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else None

    @property
    def skipped(self) -> list[str]:
        """What was left out so far because it was damaged, in words."""
        return [*self._doubts, *(text for storage in self._storages for text in storage.skipped)]

    def messages(self, names: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """Yield serialised messages in the order in which they were recorded.

        Args:
            names: Topics wanted; None means all.

        Raises:
            BagError: If a topic is not in the bag, or the bag is damaged and that is not to be skipped.
        """
        wanted = None if names is None else frozenset(names)
        self._require(wanted or ())
        for storage in self._storages:
            yield from storage.messages(wanted)

    def read(self, names: Iterable[str] | None = None) -> Iterator[Value]:
        """Yield what the messages say, in the order in which they were recorded.

        Args:
            names: Topics wanted; None means all.

        Raises:
            BagError: As `messages`, or if a message is not what its topic carries.
        """
        for message in self.messages(names):
            yield Value(message.topic, message.stamp, self._decode(message, self._deserialise(message)))

    def ticks(self, wanted: Sequence[Topic], *, endings: bool = False) -> Iterator[Tick]:
        """Yield the ticks in which every one of these topics said something, by the stamps in the messages.

        Args:
            wanted: The topics.
            endings: Yield an episode's last tick as well, which no module answers: what modules say is None there.
                `topics.TRUE_EPISODE` must be wanted, since it tells which tick that is.

        Raises:
            BagError: As `read`.
        """
        names = [topic.name for topic in wanted]
        join: Synchroniser[Any] = Synchroniser(names, HELD_TICKS)
        unanswered = [topic.name for topic in wanted if topic in topics.SIMULATOR_TOPICS] if endings else []
        ending: Synchroniser[Any] | None = Synchroniser(unanswered, HELD_TICKS) if unanswered else None
        for message in self.messages(names):
            content = self._deserialise(message)
            stamp, value = conversions.stamp_of(content), self._decode(message, content)
            complete = join.add(message.topic, stamp, value)
            if complete is None and ending is not None and message.topic in unanswered:
                last = ending.add(message.topic, stamp, value)
                if last is not None and _is_over(last[topics.TRUE_EPISODE.name]):
                    complete = last
            if complete is not None:
                yield Tick(stamp, tuple(complete.get(name) for name in names))
        join.clear()
        self.incomplete = join.dropped

    @cached_property
    def types(self) -> TypeRegistry:
        """The bag's message types, as they were when it was recorded."""
        schemas = {name: text for storage in self._storages for name, text in storage.schemas.items()}
        if all(info.type_name in schemas for info in self.topics.values()):
            return types_of_schemas(tuple(schemas.items()))
        return known_types()

    def _deserialise(self, message: BagMessage) -> Any:
        try:
            return self.types.deserialise(message.type_name, message.data)
        except BagError as error:
            raise BagError(f"{self.path}, topic {message.topic}: {error}") from None

    def _decode(self, message: BagMessage, content: Any) -> Any:
        topic, decode = _DECODER_BY_NAME.get(message.topic, (None, None))
        if topic is None or decode is None:
            return content
        if message.type_name != topic.type_name:
            raise BagError(f"{self.path}: {topic.name} is of type {message.type_name}, expected {topic.type_name}")
        try:
            return decode(content)
        except AttributeError as error:
            reason = f"recorded with another definition of {topic.type_name}: {error}"
            raise BagError(f"{self.path}, topic {topic.name}: {reason}") from None
        except ValueError as error:
            raise BagError(f"{self.path}, topic {topic.name} at {message.stamp} ns: {error}") from None

    def _require(self, names: Iterable[str]) -> None:
        missing = sorted(set(names) - self.topics.keys())
        if missing:
            has = ", ".join(sorted(self.topics)) or "none"
            raise BagError(f"no topic {', '.join(missing)} in bag {self.path}; its topics: {has}")


def _is_over(episode: conversions.EpisodeTruthReading) -> bool:
    return episode.terminated or episode.truncated


def open_bag(path: str | Path, *, damaged: Damage = "refuse") -> Bag:
    """Open a bag: a folder, with or without metadata.yaml, or one .mcap or .db3 file.

    Args:
        path: The bag.
        damaged: "refuse" raises about every sign of damage, also while reading; "skip" leaves out damaged chunks
            of MCAP files and what is behind the last whole one, and lists them in `Bag.skipped`.

    Raises:
        BagError: If there is no bag, a file of it is missing, or it is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"no bag at {path}, expected a folder or a file (.mcap, .db3) of one")
    if not path.is_dir():
        storage, identity = _storage(path, damaged), read_identity(path)
        return Bag(path, [storage], about=identity and identity.about)
    metadata = Metadata.read(path)
    files = sorted((*path.glob("*.mcap"), *path.glob("*.db3")), key=_number)
    doubts = _Doubts(path, damaged)
    if metadata is None:
        if not files:
            raise BagError(f"{path} is not a bag: it has neither {FILE_NAME} nor .mcap or .db3 files")
        return _without_metadata(path, files, doubts)
    if metadata.storage not in ("mcap", "sqlite3") or metadata.compression_mode in ("file", "message"):
        kind = f"{metadata.storage} storage {metadata.compression_mode}".strip()
        raise BagError(f"{path} has {kind}: expected sqlite3, or mcap without compression of files or messages")
    listed = _listed(path, metadata, files, doubts)
    if metadata.storage == "sqlite3":
        if not all(file.digest for file in listed):
            text = f"{path} carries no checksums, so that damage to its messages goes unseen"
            warnings.warn(f"{text}; `ros2 bag reindex` adds them", stacklevel=2)
        storages: list[Storage] = [SqliteBag(path, [path / file.path for file in listed])]
        _compare_counts(sum(file.count for file in listed), listed, storages[0], doubts)
        return Bag(path, storages, doubts.noted, metadata.about, metadata.distribution)
    storages = []
    for file in listed:
        storage = _storage(path / file.path, damaged)
        storages.append(storage)
        if isinstance(storage, McapFile) and storage.complete:
            _compare_counts(file.count, [file], storage, doubts)
    return Bag(path, storages, doubts.noted, metadata.about, metadata.distribution)


class _Doubts:
    """What is wrong with the files of a bag: an error, or a note where damage is to be skipped."""

    def __init__(self, path: Path, damaged: Damage) -> None:
        self._path, self._skip = path, damaged == "skip"
        self.noted: list[str] = []

    @property
    def skips(self) -> bool:
        """Whether doubts are noted alone."""
        return self._skip

    def __call__(self, what: str) -> None:
        if not self._skip:
            raise BagError(f"{self._path} is damaged: {what}; `ros2 bag reindex BAG` keeps what is whole")
        self.noted.append(what)


def _without_metadata(path: Path, files: Sequence[Path], doubts: _Doubts) -> Bag:
    """Open a bag that has lost its metadata.yaml."""
    for file in files:
        require_regular(file)
    identities = {file: read_identity(file) for file in files}
    storages = {file: _storage(file, "skip" if doubts.skips else "refuse") for file in files}
    ours = [storage for file, storage in storages.items() if identities[file] is not None]
    last = any(isinstance(storage, McapFile) and storage.is_last for storage in ours)
    kept = check_family(identities, doubts, last=last)
    about = next((identity.about for file in kept if (identity := identities[file]) is not None), None)
    return Bag(path, [storages[file] for file in kept], doubts.noted, about)


def _listed(path: Path, metadata: Metadata, files: Sequence[Path], doubts: _Doubts) -> list[FileRecord]:
    """Return the files that metadata.yaml lists and that are those that it means."""
    if not metadata.files:
        doubts(f"{FILE_NAME} lists no file")
    names = [file.path for file in metadata.files]
    for name in sorted({file.name for file in files} - set(names)):
        doubts(f"{name} is not listed in its {FILE_NAME}")
    kept: dict[str, FileRecord] = {}
    for file in metadata.files:
        at = path / file.path
        if file.path in kept:
            doubts(f"{FILE_NAME} lists {file.path} twice")
            continue
        require_regular(at)
        identity = read_identity(at) if at.suffix == ".mcap" else None
        if metadata.bag and identity is not None and identity.bag != metadata.bag:
            doubts(f"{file.path} is of another bag")
            continue
        if file.digest and file_digest(at) != file.digest:
            doubts(f"{file.path} is damaged or another file: its SHA-256 is not the one in {FILE_NAME}")
        kept[file.path] = file
    return list(kept.values())


def _compare_counts(expected: int, files: Sequence[FileRecord], storage: Storage, doubts: _Doubts) -> None:
    """Compare the messages and their times with what metadata.yaml says, where it says so."""
    if not all(file.stated for file in files):
        return
    count = storage.count
    names = ", ".join(file.path for file in files)
    if count != expected:
        doubts(f"{names} has {count} messages, not {expected} as {FILE_NAME} says")
    elif count and storage.span != (span := (min(f.start for f in files), max(f.end for f in files))):
        doubts(f"{names} reaches from {storage.span} ns, not {span} as {FILE_NAME} says")


def _storage(path: Path, damaged: Damage) -> Storage:
    require_regular(path)
    if path.suffix == ".mcap":
        return McapFile(path, damaged)
    if path.suffix == ".db3":
        return SqliteBag(path, [path])
    raise BagError(f"{path} is not a bag: expected a folder, .mcap or .db3")


def _number(path: Path) -> tuple[int, str]:
    """Sort `x_2.mcap` before `x_10.mcap`."""
    match = re.search(r"_(\d+)$", path.stem)
    return (int(match[1]) if match else 0, path.name)
