"""Read rosbag2 bags: raw messages, NumPy values, or whole ticks."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.metadata import FILE_NAME, Metadata
from mujoban_msgs_py.bags.storage import Damage, McapFile, RawMessage, SqliteBag, Storage, TopicInfo
from mujoban_msgs_py.bags.types import TypeRegistry
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
        incomplete: After `ticks`: messages that found no partner, by topic.
    """

    def __init__(self, path: Path, storages: Sequence[Storage]) -> None:
        """Use `open_bag`."""
        self.path = path
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
        return [text for storage in self._storages for text in storage.skipped]

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
                `topics.EPISODE` must be wanted, since it tells which tick that is.

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
                if last is not None and _is_over(last[topics.EPISODE.name]):
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
            return TypeRegistry.of_schemas(schemas)
        return TypeRegistry()

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
        raise BagError(f"no bag at {path}")
    if path.is_file():
        return Bag(path, [_storage(path, damaged)])
    metadata = Metadata.read(path)
    if metadata is None:
        files = sorted((*path.glob("*.mcap"), *path.glob("*.db3")), key=_number)
        if not files:
            raise BagError(f"{path} is not a bag: it has neither {FILE_NAME} nor .mcap or .db3 files")
        return Bag(path, [_storage(file, damaged) for file in files])
    if metadata.storage == "sqlite3":
        return Bag(path, [SqliteBag(path)])
    if metadata.storage != "mcap" or metadata.compression_mode in ("file", "message"):
        kind = f"{metadata.storage} storage {metadata.compression_mode}".strip()
        raise BagError(f"{path} has {kind}: expected sqlite3, or mcap without compression of files or messages")
    return Bag(path, [_storage(path / file.path, damaged) for file in metadata.files])


def _storage(path: Path, damaged: Damage) -> Storage:
    if path.suffix == ".mcap":
        return McapFile(path, damaged)
    if path.suffix == ".db3":
        return SqliteBag(path)
    raise BagError(f"{path} is not a bag: expected a folder, .mcap or .db3")


def _is_over(episode: conversions.EpisodeReading) -> bool:
    return episode.terminated or episode.truncated


def _number(path: Path) -> tuple[int, str]:
    """Sort `x_2.mcap` before `x_10.mcap`."""
    match = re.search(r"_(\d+)$", path.stem)
    return (int(match[1]) if match else 0, path.name)
