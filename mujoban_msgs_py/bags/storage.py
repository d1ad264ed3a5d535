"""The files of a bag: raw messages out of MCAP and sqlite3, in bounded memory, with damage noticed."""

from __future__ import annotations

import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import apsw
import yaml
import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import ReaderError

from mujoban_msgs_py.bags.chunks import open_chunk
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.integrity import LAST, require_regular
from mujoban_msgs_py.bags.metadata import load_qos

Damage = Literal["refuse", "skip"]
"""What to do about damage: raise `BagError`, or leave out the damaged chunk and go on."""

RECORD_LIMIT: Final = 1 << 28
"""Bytes of a record above which its length is taken for damage."""

_MAGIC: Final = b"\x89MCAP0\r\n"
_DAMAGE: Final = (
    McapError, CRCValidationError, struct.error, zlib.error, zstandard.ZstdError, EOFError, UnicodeDecodeError,
    RuntimeError, ValueError, MemoryError,
)  # fmt: skip
"""What the decoders raise on damaged bytes; lz4 raises RuntimeError."""


@dataclass
class TopicInfo:
    """A topic of a bag."""

    name: str
    type_name: str
    count: int
    qos: list[dict[str, Any]]


class RawMessage(NamedTuple):
    """A message as it is stored."""

    topic: str
    type_name: str
    stamp: int
    """Log time in nanoseconds."""
    data: bytes
    """CDR."""


class Storage(ABC):
    """Some of a bag's messages.

    Attributes:
        path: The file, for messages about it.
        skipped: What was left out because it was damaged, in words.
    """

    def __init__(self, path: Path) -> None:
        """Remember the file."""
        self.path = path
        self.skipped: list[str] = []

    @property
    @abstractmethod
    def topics(self) -> dict[str, TopicInfo]:
        """The topics by name."""

    @property
    def count(self) -> int:
        """Messages."""
        return sum(topic.count for topic in self.topics.values())

    @property
    @abstractmethod
    def schemas(self) -> dict[str, str]:
        """Type name -> concatenated definition, of the types whose definition the file holds."""

    @property
    @abstractmethod
    def span(self) -> tuple[int, int] | None:
        """First and last log time, or None without messages."""

    @abstractmethod
    def messages(self, topics: frozenset[str] | None) -> Iterator[RawMessage]:
        """Yield the messages of these topics (None: of all) in the order of the file.

        Raises:
            BagError: If the file is damaged, and that is not to be skipped.
        """


class _Contents(NamedTuple):
    topics: dict[str, TopicInfo]
    schemas: dict[str, str]
    span: tuple[int, int] | None
    channels: dict[int, Channel]
    types: dict[int, Schema]


class McapFile(Storage):
    """One MCAP file."""

    def __init__(self, path: Path, damaged: Damage) -> None:
        """Check that the file is complete, unless damage is to be skipped.

        Raises:
            BagError: If it is no MCAP file, or is truncated and that is not to be skipped.
        """
        super().__init__(path)
        self._skip = damaged == "skip"
        require_regular(path)
        try:
            with path.open("rb") as stream:
                head = stream.read(len(_MAGIC))
                stream.seek(max(0, path.stat().st_size - len(_MAGIC)))
                self.complete = stream.read() == _MAGIC and path.stat().st_size > len(_MAGIC)
        except OSError as error:
            raise BagError(f"cannot read {path}: {error.strerror}") from None
        if head != _MAGIC and not (self._skip and _MAGIC.startswith(head)):
            raise BagError(f"{path} is not an MCAP file: it does not begin with the MCAP magic")
        if not self.complete:
            self._damage("is truncated: it has no footer, as after a recorder was killed")

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics by name."""
        return self._contents.topics

    @property
    def schemas(self) -> dict[str, str]:
        """Type name -> concatenated definition."""
        return self._contents.schemas

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time."""
        return self._contents.span

    @cached_property
    def is_last(self) -> bool:
        """Whether the file says that it is the last of its bag."""
        if not self.complete:
            return False
        try:
            with self.path.open("rb") as stream:
                summary = SeekingReader(stream).get_summary()
        except _DAMAGE:
            return False
        return summary is not None and any(index.name == LAST for index in summary.metadata_indexes)

    @cached_property
    def _contents(self) -> _Contents:
        """What the summary says; without one, what a pass over the whole file finds."""
        summary = None
        if self.complete:
            try:
                with self.path.open("rb") as stream:
                    summary = SeekingReader(stream, validate_crcs=True).get_summary()
            except _DAMAGE as error:
                self._damage(f"has a damaged summary: {error}")
        if summary is None or summary.statistics is None:
            return self._scan()
        statistics = summary.statistics
        counts = statistics.channel_message_counts
        span = (statistics.message_start_time, statistics.message_end_time) if statistics.message_count else None
        return self._gather(summary.channels, summary.schemas, counts, span)

    def _scan(self) -> _Contents:
        channels: dict[int, Channel] = {}
        types: dict[int, Schema] = {}
        counts: dict[int, int] = {}
        span: tuple[int, int] | None = None
        for record in self._records(note=False):
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                types[record.id] = record
            elif isinstance(record, Message):
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                first, last = span or (record.log_time, record.log_time)
                span = min(first, record.log_time), max(last, record.log_time)
        return self._gather(channels, types, counts, span)

    def _gather(
        self, channels: dict[int, Channel], types: dict[int, Schema], counts: dict[int, int],
        span: tuple[int, int] | None,
    ) -> _Contents:  # fmt: skip
        topics: dict[str, TopicInfo] = {}
        for channel in channels.values():
            if channel.schema_id not in types:
                continue  # of another encoding, such as JSON, which nothing here reads
            info = topics.get(channel.topic)
            if info is None:
                qos = self._qos_of(channel)
                info = topics[channel.topic] = TopicInfo(channel.topic, types[channel.schema_id].name, 0, qos)
            info.count += counts.get(channel.id, 0)
        texts = {s.name: self._text_of(s) for s in types.values() if s.encoding == "ros2msg"}
        schemas = {name: text for name, text in texts.items() if text is not None}
        return _Contents(topics, schemas, span, channels, types)

    def _qos_of(self, channel: Channel) -> list[dict[str, Any]]:
        try:
            return load_qos(channel.metadata.get("offered_qos_profiles", ""))
        except (yaml.YAMLError, TypeError, ValueError):
            self._damage(f"has QoS profiles of {channel.topic} that are no list in YAML")
            return []

    def _text_of(self, schema: Schema) -> str | None:
        try:
            return schema.data.decode()
        except UnicodeDecodeError:
            self._damage(f"has a definition of {schema.name} that is no text")
            return None

    def messages(self, topics: frozenset[str] | None) -> Iterator[RawMessage]:
        """Yield the messages of these topics (None: of all) in the order of the file."""
        # From the summary where there is one, since the chunk that introduces a channel may be the damaged one.
        channels, types = dict(self._contents.channels), dict(self._contents.types)
        for record in self._records(note=True):
            if isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None or channel.schema_id not in types:
                    continue
                if topics is not None and channel.topic not in topics:
                    continue
                yield RawMessage(channel.topic, types[channel.schema_id].name, record.log_time, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                types[record.id] = record

    def _records(self, *, note: bool) -> Iterator[Channel | Schema | Message]:
        """Yield the records of the data section; `note` whether damage that is skipped is written down."""
        with self.path.open("rb") as stream:
            # A whole-file checksum could only fail after a damaged chunk has been skipped.
            reader = StreamReader(
                stream, emit_chunks=True, validate_crcs=not self._skip, record_size_limit=RECORD_LIMIT
            )
            records = iter(reader.records)
            number = 0
            while True:
                try:
                    record = next(records, None)
                except _DAMAGE as error:
                    if self.complete or not self._skip:
                        self._damage(f"is damaged after chunk {number}: {_reason(error)}", note=note)
                    return
                if record is None:
                    return
                if isinstance(record, Chunk):
                    number += 1
                    yield from self._open_chunk(record, number, note)
                elif isinstance(record, Channel | Schema | Message):
                    yield record

    def _open_chunk(self, chunk: Chunk, number: int, note: bool) -> Iterator[Channel | Schema | Message]:
        try:
            records = open_chunk(chunk)
        except _DAMAGE as error:
            self._damage(f"has a damaged chunk, number {number}: {_reason(error)}", note=note)
            return
        for record in records:
            if isinstance(record, Channel | Schema | Message):
                yield record

    def _damage(self, what: str, *, note: bool = True) -> None:
        if not self._skip:
            raise BagError(f"{self.path} {what}; `ros2 bag reindex BAG` keeps what is whole")
        if note and (text := f"{self.path.name} {what}") not in self.skipped:
            self.skipped.append(text)


class SqliteBag(Storage):
    """sqlite3 storage: a folder with its metadata.yaml, or one .db3 file."""

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        """Look over its database files.

        Raises:
            BagError: If one of them is missing, or is no whole database.
        """
        super().__init__(path)
        self._count = 0
        for file in files:
            require_regular(file)
            self._count += _count_messages(file)

    @property
    def count(self) -> int:
        """Messages in the files, which metadata.yaml may see differently."""
        return self._count

    @cached_property
    def topics(self) -> dict[str, TopicInfo]:
        """The topics by name."""
        with self._open() as reader:
            return {c.topic: TopicInfo(c.topic, c.msgtype, c.msgcount, _qos_of(c.ext)) for c in reader.connections}

    @cached_property
    def schemas(self) -> dict[str, str]:
        """Type name -> concatenated definition, where the file holds one."""
        with self._open() as reader:
            return {c.msgtype: c.msgdef.data for c in reader.connections if c.msgdef.data}

    @cached_property
    def span(self) -> tuple[int, int] | None:
        """First and last log time."""
        with self._open() as reader:
            return (reader.start_time, reader.end_time - 1) if reader.message_count else None

    def messages(self, topics: frozenset[str] | None) -> Iterator[RawMessage]:
        """Yield the messages of these topics (None: of all) by log time."""
        with self._open() as reader:
            wanted = [c for c in reader.connections if topics is None or c.topic in topics]
            if not wanted:
                return
            with closing(reader.messages(wanted)) as rows:
                while True:
                    try:
                        row = next(rows, None)
                    except (apsw.Error, ReaderError) as error:
                        raise BagError(f"{self.path} is damaged: {error}") from None
                    if row is None:
                        return
                    connection, stamp, data = row
                    yield RawMessage(connection.topic, connection.msgtype, stamp, bytes(data))

    @contextmanager
    def _open(self) -> Iterator[RosbagsReader]:
        try:
            reader = RosbagsReader(self.path)
            reader.open()
        except (ReaderError, apsw.Error, OSError) as error:
            raise BagError(f"cannot read {self.path}: {error}") from None
        try:
            yield reader
        finally:
            reader.close()


def _count_messages(path: Path) -> int:
    """Return the messages of a database whose structure is whole; what they say has no checksum in it."""
    try:
        with closing(apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)) as database:
            said = [row[0] for row in database.execute("PRAGMA integrity_check(1)")]
            count = next(database.execute("SELECT count(*) FROM messages"))[0]
    except (apsw.Error, UnicodeDecodeError) as error:
        raise BagError(f"{path} is damaged: {_reason(error)}") from None
    if said != ["ok"]:
        raise BagError(f"{path} is damaged: {' '.join(str(said[0]).split())}")
    return int(count)


def _qos_of(extension: Any) -> list[dict[str, Any]]:
    """Return rosbags' QoS profiles as bags carry them."""
    return [
        {
            "history": profile.history.name.lower(),
            "depth": profile.depth,
            "reliability": profile.reliability.name.lower(),
            "durability": profile.durability.name.lower(),
        }
        for profile in extension.offered_qos_profiles
    ]


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
