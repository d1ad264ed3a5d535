"""Write rosbag2 bags in MCAP."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from mcap.writer import CompressionType, Writer

from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.integrity import IDENTITY, LAST, HashedFile, Identity, Reserve, dump_identity
from mujoban_msgs_py.bags.metadata import FileRecord, Metadata, TopicRecord, dump_qos, qos_profile
from mujoban_msgs_py.bags.types import known_types
from mujoban_msgs_py.topics import Topic

CHUNK_SIZE: Final = 1 << 20
"""Bytes of a chunk before compression."""
FLUSH_AFTER: Final = 8
"""`BagWriter.flush_after` of what records the graph: ticks that a recorder loses at most when it is killed."""
PROFILE: Final = "ros2"
_SUMMARY: Final = 1 << 18
"""Bytes that the end of a file and metadata.yaml take at most; they and a chunk find room on a full disk."""

_COMPRESSION: Final = {"": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


class BagWriter:
    """A bag of MCAP files with chunk and file checksums, and one file per so many episodes.

    metadata.yaml exists from the first message on. Of a writer that is killed all whole chunks can be read: see
    `open_bag` and `recover_bag`. Where the disk is full, the bag is finished with all that was written, in room that is
    held for that.
    """

    def __init__(
        self,
        path: str | Path,
        topics: Iterable[Topic] = (),
        *,
        episodes_per_file: int | None = None,
        chunk_size: int = CHUNK_SIZE,
        compression: str = "zstd",
        flush_after: int | None = None,
        about: Mapping[str, str] | None = None,
    ) -> None:
        """Make the bag's folder and open its first file.

        Args:
            path: The folder to make.
            topics: What is recorded; `add_topic` adds others.
            episodes_per_file: Calls of `end_episode` after which a new file is begun; None means one file.
            chunk_size: Bytes of a chunk before compression.
            compression: Of chunks: "zstd", "lz4" or "" for none.
            flush_after: Different stamps after which a chunk is finished, which is all that a writer that is killed
                can lose; None leaves it to the chunk's size.
            about: What is recorded, for `Metadata.about`.

        Raises:
            BagError: If there is something at `path` already, or an option is out of its range.
        """
        if compression not in _COMPRESSION:
            raise BagError(f"compression must be 'zstd', 'lz4' or '', got {compression!r}")
        counts = {"episodes_per_file": episodes_per_file, "chunk_size": chunk_size, "flush_after": flush_after}
        for name, value in counts.items():
            if value is not None and value < 1:
                raise BagError(f"{name} must be at least 1, got {value}")
        self.path = Path(path)
        self._episodes_per_file = episodes_per_file
        self._chunk_size = chunk_size
        self._compression = _COMPRESSION[compression]
        self._types = known_types()
        self._metadata = Metadata(bag=secrets.token_hex(16), about=dict(about or {}))
        self._flush_after = flush_after
        self._stamps: set[int] = set()
        self._episodes = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stream: HashedFile | None = None
        self._is_split = False
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f"{self.path} exists already: a bag needs a new folder") from None
        try:
            self._reserve = Reserve(self.path, chunk_size + _SUMMARY)
        except OSError:
            self.path.rmdir()
            raise
        for topic in topics:
            self._note(topic.name, topic.type_name, [qos_profile(latched=topic.latched, depth=topic.depth)])
        self._open_file()

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written."""
        return self._stream is None

    @property
    def counts(self) -> dict[str, int]:
        """Messages written, by topic."""
        return {topic.name: topic.count for topic in self._metadata.topics.values()}

    def add_topic(self, name: str, type_name: str, qos: Sequence[Mapping[str, Any]] = ()) -> None:
        """Add a topic of a ROS type such as `std_msgs/msg/Header`; known ones stay as they are.

        Raises:
            BagError: If the type is unknown, or the topic is in the bag with another type.
        """
        if name not in self._metadata.topics:
            self._register(self._note(name, type_name, qos))
            self._write_metadata()
        elif self._metadata.topics[name].type_name != type_name:
            known = self._metadata.topics[name].type_name
            raise BagError(f"topic {name} of {self.path} is of type {known}, not {type_name}")

    def _note(self, name: str, type_name: str, qos: Sequence[Mapping[str, Any]]) -> TopicRecord:
        profiles = [dict(p) for p in qos] or [qos_profile()]
        record = TopicRecord(name, type_name, self._types.type_hash(type_name), profiles)
        self._metadata.topics[name] = record
        return record

    def write(self, topic: str, stamp: int, data: bytes, published: int | None = None) -> None:
        """Write one serialised message.

        Args:
            topic: Its topic, which has been added.
            stamp: Log time in nanoseconds; simulated time in bags of the graph.
            data: The message in CDR, as raw subscriptions deliver it.
            published: Publication time in nanoseconds; None means `stamp`.

        Raises:
            BagError: If the topic is unknown or the bag is closed.
            OSError: If the disk is full; the bag is closed, with this message in it.
        """
        channel = self._channels.get(topic)
        if channel is None or self._stream is None:
            reason = "is closed" if self._stream is None else f"has no topic {topic!r}"
            raise BagError(f"cannot write to {self.path}: it {reason}")
        if self._is_split:
            self._close_file()
            self._open_file()
            channel = self._channels[topic]
        record = self._metadata.topics[topic]
        self._writer.add_message(channel, stamp, data, stamp if published is None else published, record.count)
        record.count += 1
        self._metadata.files[-1].add(stamp)
        if self._flush_after is not None:
            self._stamps.add(stamp)
            if len(self._stamps) > self._flush_after:
                self.flush()
        if (full := self._reserve.full) is not None:
            self.close()
            raise OSError(full.errno, full.strerror, str(self.path))

    def end_episode(self) -> None:
        """Note that an episode is complete; after `episodes_per_file` of them a new file is begun."""
        self._episodes += 1
        if self._episodes_per_file is not None and self._episodes % self._episodes_per_file == 0:
            self.split()

    def split(self) -> None:
        """Begin the next file with the next message, unless the file is still empty."""
        self._is_split = self._metadata.files[-1].count > 0

    def flush(self) -> None:
        """Finish the chunk in progress, so that a reader can see everything written so far."""
        if self._stream is not None:
            self._writer.flush()
            self._stamps.clear()

    def close(self) -> None:
        """Finish the last file and metadata.yaml; a second call does nothing."""
        if self._stream is None:
            return
        self._writer.add_metadata(LAST, {})
        self._close_file()
        self._write_metadata()
        self._reserve.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open_file(self) -> None:
        file = FileRecord(f"{self.path.name}_{len(self._metadata.files)}.mcap")
        self._stream, self._is_split = HashedFile(self.path / file.path, self._reserve), False
        self._writer = Writer(
            self._stream,  # pyright: ignore[reportArgumentType]  # what it calls
            chunk_size=self._chunk_size,
            compression=self._compression,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile=PROFILE)
        identity = Identity(self._metadata.bag, len(self._metadata.files), self._metadata.about)
        self._writer.add_metadata(IDENTITY, dump_identity(identity))
        self._channels, self._schemas = {}, {}
        self._metadata.files.append(file)
        for topic in self._metadata.topics.values():
            self._register(topic)
        self._write_metadata()

    def _write_metadata(self) -> None:
        try:
            self._metadata.write(self.path)
        except OSError as error:
            if not self._reserve.released(error):
                raise
            self._metadata.write(self.path)

    def _close_file(self) -> None:
        assert self._stream is not None
        self._writer.finish()
        self._metadata.files[-1].digest = self._stream.digest
        self._stream.close()
        self._stream = None

    def _register(self, topic: TopicRecord) -> None:
        if topic.type_name not in self._schemas:
            text = self._types.definition(topic.type_name)
            self._schemas[topic.type_name] = self._writer.register_schema(topic.type_name, "ros2msg", text.encode())
        details = {"offered_qos_profiles": dump_qos(topic.qos), "topic_type_hash": topic.type_hash}
        self._channels[topic.name] = self._writer.register_channel(
            topic.name, "cdr", self._schemas[topic.type_name], details
        )
