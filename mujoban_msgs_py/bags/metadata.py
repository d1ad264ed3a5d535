"""metadata.yaml of a rosbag2 bag: what files it has and what is in them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from textwrap import indent
from typing import Any, Final

import yaml

from mujoban_core.files import write_atomically
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.integrity import dump_about, load_about

FILE_NAME: Final = "metadata.yaml"
VERSION: Final = 9
"""Of the format: that of ROS 2 Jazzy."""
DISTRIBUTION: Final = "jazzy"

_KEY: Final = "rosbag2_bagfile_information"
_TOPICS: Final = "topics_with_message_count"
_BAG: Final = "mujoban_bag"
"""Key of `Metadata.bag` in the custom data."""
_DIGEST: Final = "sha256/"
"""Beginning of the keys of the files' checksums in the custom data."""
_OWN_DIGEST: Final = "mujoban_metadata_sha256"
"""Key of the checksum of all else in the file."""
_FOREVER: Final = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(*, latched: bool = False, reliable: bool = True, depth: int = 10) -> dict[str, Any]:
    """Return a QoS profile as bags carry it."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


@dataclass
class TopicRecord:
    """A topic of a bag."""

    name: str
    type_name: str
    type_hash: str
    qos: list[dict[str, Any]]
    count: int = 0


@dataclass
class FileRecord:
    """A file of a bag; times in nanoseconds."""

    path: str
    start: int = 0
    end: int = 0
    count: int = 0
    digest: str = ""
    """SHA-256 of the file in hexadecimal; empty where it is not known."""
    stated: bool = True
    """Whether start, end and count are known."""

    def add(self, stamp: int) -> None:
        """Count a message."""
        self.start = stamp if self.count == 0 else min(self.start, stamp)
        self.end = max(self.end, stamp)
        self.count += 1


@dataclass
class Metadata:
    """What metadata.yaml says."""

    storage: str = "mcap"
    topics: dict[str, TopicRecord] = field(default_factory=dict)
    files: list[FileRecord] = field(default_factory=list)
    compression_mode: str = ""
    bag: str = ""
    """What tells this bag from all others; empty for those of other writers."""
    about: dict[str, str] = field(default_factory=dict)
    """What was recorded, such as `world` and `body`."""
    distribution: str = DISTRIBUTION
    """Of the ROS 2 that recorded it; empty where it does not say."""

    def write(self, folder: Path) -> None:
        """Replace the file in `folder` atomically."""
        information = self._information()
        if self.bag:
            information["custom_data"][_OWN_DIGEST] = _digest(information)
        write_atomically(folder / FILE_NAME, _dump_information(information).encode())

    @classmethod
    def read(cls, folder: Path) -> Metadata | None:
        """Return what the file in `folder` says, or None if there is none.

        Raises:
            BagError: If it is malformed.
        """
        path = folder / FILE_NAME
        if not path.is_file():
            return None
        try:
            information = yaml.load(path.read_text(), _SafeLoader)[_KEY]
            topics = [_topic(entry) for entry in information[_TOPICS]]
            custom = information.get("custom_data") or {}
            stated = custom.pop(_OWN_DIGEST, None)
            if stated is not None and stated != _digest(information):
                raise ValueError("its checksum is not that of its content")
            return cls(
                storage=_text(information["storage_identifier"]),
                topics={topic.name: topic for topic in topics},
                files=_files(information, custom),
                compression_mode=_text(information.get("compression_mode") or "").lower(),
                bag=_text(custom.get(_BAG, "")),
                distribution=_text(information.get("ros_distro") or ""),
                about={name: _text(value) for name, value in load_about(custom).items()},
            )
        except (yaml.YAMLError, LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise BagError(f"{path} is not the metadata of a rosbag2 bag: {type(error).__name__} {reason}") from None

    def _information(self) -> dict[str, Any]:
        filled = [file for file in self.files if file.count]
        start = min((file.start for file in filled), default=0)
        end = max((file.end for file in filled), default=0)
        return {
            "version": VERSION,
            "storage_identifier": self.storage,
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(file.count for file in self.files),
            _TOPICS: [_topic_entry(topic) for topic in self.topics.values()],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.path for file in self.files],
            "files": [_file_entry(file) for file in self.files],
            "custom_data": self._custom() or None,
            "ros_distro": self.distribution,
        }

    def _custom(self) -> dict[str, str]:
        digests = {_DIGEST + file.path: file.digest for file in self.files if file.digest}
        return digests | dump_about(self.about) | ({_BAG: self.bag} if self.bag else {})


# libyaml writes ten times as fast: a recording of many bags closes in the time that a user waits for.
_SafeDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Dumper(_SafeDumper):
    """Writes every QoS profile out: rosbag2's own parser knows no YAML aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _dump(content: object) -> str:
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=False)


def _dump_information(information: Mapping[str, Any]) -> str:
    """Return the file's text; a recorder has many bags of the same topics, of which only the counts differ."""
    topics = "".join(_dump_entry(**entry) for entry in information[_TOPICS])
    before, empty, after = _dump({_KEY: {**information, _TOPICS: []}}).partition(f"  {_TOPICS}: []\n")
    return f"{before}  {_TOPICS}:\n{topics}{after}" if topics else f"{before}{empty}{after}"


def _dump_entry(topic_metadata: Mapping[str, Any], message_count: int) -> str:
    return f"{_dump_topic(json.dumps(topic_metadata))}    message_count: {message_count}\n"


@lru_cache(maxsize=256)
def _dump_topic(described: str) -> str:
    return indent(_dump([{"topic_metadata": json.loads(described)}]), "  ")


def _digest(information: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(information).encode()).hexdigest()


def dump_qos(profiles: Sequence[Mapping[str, Any]]) -> str:
    """Return QoS profiles as the YAML text that MCAP channels carry."""
    return _dump_profiles(json.dumps([dict(p) for p in profiles]))


@lru_cache(maxsize=256)
def _dump_profiles(profiles: str) -> str:
    return _dump(json.loads(profiles)).strip()


def load_qos(text: str | Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return QoS profiles from metadata.yaml or an MCAP channel."""
    profiles = yaml.load(text, _SafeLoader) if isinstance(text, str) else text
    return [dict(p) for p in profiles or []]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def _count(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise TypeError(f"{value!r} is no count")
    return value


def _files(information: Mapping[str, Any], custom: Mapping[str, Any]) -> list[FileRecord]:
    """Return what is said of each file that is listed."""
    stated = {_text(entry["path"]): entry for entry in information.get("files") or []}
    files = []
    for name in map(_text, information["relative_file_paths"]):
        file = FileRecord(Path(name).name, digest=_text(custom.get(_DIGEST + name, "")), stated=name in stated)
        if file.stated:
            entry = stated[name]
            file.start = _count(entry["starting_time"]["nanoseconds_since_epoch"])
            file.end = file.start + _count(entry["duration"]["nanoseconds"])
            file.count = _count(entry["message_count"])
        files.append(file)
    return files


def _topic(entry: Mapping[str, Any]) -> TopicRecord:
    told = entry["topic_metadata"]
    return TopicRecord(
        name=_text(told["name"]),
        type_name=_text(told["type"]),
        type_hash=_text(told.get("type_description_hash", "")),
        qos=load_qos(told.get("offered_qos_profiles", [])),
        count=_count(entry["message_count"]),
    )


def _topic_entry(topic: TopicRecord) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": topic.name,
            "type": topic.type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": topic.qos,
            "type_description_hash": topic.type_hash,
        },
        "message_count": topic.count,
    }


def _file_entry(file: FileRecord) -> dict[str, Any]:
    return {
        "path": file.path,
        "starting_time": {"nanoseconds_since_epoch": file.start},
        "duration": {"nanoseconds": file.end - file.start},
        "message_count": file.count,
    }
