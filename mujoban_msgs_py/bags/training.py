"""The one reader of training episodes: it finds bags, checks them, and never yields a level that is not for training.

bags = [open_training_bag(path, wanted) for path in find_bags(folders)]
for episode, values in episode_ticks(bags[0], wanted):
    ...
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from mujoban_core.files import digest
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.metadata import FILE_NAME
from mujoban_msgs_py.bags.reader import Bag, open_bag
from mujoban_msgs_py.bags.recovery import PARTIAL, REPLACED
from mujoban_msgs_py.conversions import EpisodeTruthReading
from mujoban_msgs_py.topics import Topic
from mujoban_sokoban.generator import TEST_SEEDS, TRAIN_SEEDS


def find_bags(folders: Sequence[Path]) -> list[Path]:
    """Return the bags among the given paths: each is a bag, or a folder of bags.

    Names that end in `REPLACED` or `PARTIAL` are not of bags to learn from.

    Raises:
        BagError: If there is none at a path.
    """
    found: list[Path] = []
    for folder in folders:
        if not folder.exists():
            raise BagError(f"no bag at {folder}: expected a bag or a folder of bags")
        if _is_bag(folder):
            found.append(folder)
            continue
        below = sorted(p for p in folder.iterdir() if p.is_dir() and p.suffix not in (REPLACED, PARTIAL) and _is_bag(p))
        if not below:
            raise BagError(f"no bag in {folder}: expected folders with {FILE_NAME}, .mcap or .db3 files")
        found += below
    return found


def _is_bag(path: Path) -> bool:
    return path.is_file() or (path / FILE_NAME).exists() or any(path.glob("*.mcap")) or any(path.glob("*.db3"))


def open_training_bag(path: Path, wanted: Sequence[Topic], *, skip_damaged: bool = False) -> Bag:
    """Open a bag that has something of every topic wanted.

    Args:
        path: The bag.
        wanted: What training needs.
        skip_damaged: Leave damaged chunks out instead of refusing the bag.

    Raises:
        BagError: If a topic is missing, by name, or the bag is damaged and that is not to be skipped.
    """
    bag = open_bag(path, damaged="skip" if skip_damaged else "refuse")
    missing = [t.name for t in wanted if t.name not in bag.topics or bag.topics[t.name].count == 0]
    if missing:
        raise BagError(f"{path} lacks {', '.join(missing)}: expected a bag with {', '.join(t.name for t in wanted)}")
    return bag


def check_batch_share(share: float) -> None:
    """Refuse to take nothing of a batch from bags, or more than all of it.

    Raises:
        ValueError: If it is no share, or 0.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"--bag-share {share}: expected a share above 0, at most 1")


def check_share_has_bags(share: float, default: float, bags: Sequence[Path]) -> None:
    """Refuse to take another share than the default one from no bags.

    Raises:
        ValueError: If there are none.
    """
    if share != default and not bags:
        raise ValueError(f"--bag-share {share:g}: expected --bags, whose share it is")


def bags_digest(folders: Sequence[Path]) -> str | None:
    """Return the SHA-256 by which the record of weights names bags, or folders of them: of their names and checksums.

    Raises:
        BagError: As `find_bags`; without a folder there is None.
    """
    total = hashlib.sha256()
    for bag in find_bags(folders):
        total.update(f"{bag.name}\0{bag_digest(bag)}\0".encode())
    return total.hexdigest() if folders else None


def bag_digest(bag: Path) -> str:
    """Return the SHA-256 by which a bag is known again, wherever it lies: names are the same in every recording."""
    # Metadata have the checksums of all files; a bag that was cut short has none.
    metadata = bag / FILE_NAME
    return digest(metadata if metadata.is_file() else bag)


def require_training_seeds(bag: Bag) -> None:
    """Refuse a bag that begins with an episode whose level is not for training; recorders count seeds upwards.

    It reads one message, so that it can be asked before anything else is started; `episode_ticks` looks at all.

    Raises:
        BagError: If it does, or is damaged.
    """
    if (episode := _first_episode(bag)) is not None:
        _require_training_level(bag, episode)


def require_untested(bag: Bag) -> None:
    """Refuse to choose by a bag that begins with an episode whose level is for tests; as `require_training_seeds`.

    Raises:
        BagError: If it does, or is damaged.
    """
    episode = _first_episode(bag)
    if episode is not None and episode.difficulty and episode.seed in TEST_SEEDS:
        raise BagError(
            f"{bag.path} holds an episode with seed {episode.seed}, one for tests, by which nothing is chosen: "
            "expected validation or training levels"
        )


def _first_episode(bag: Bag) -> EpisodeTruthReading | None:
    return next((value.value for value in bag.read([topics.TRUE_EPISODE.name])), None)


def require_about(bag: Bag, expected: Mapping[str, str], source: str) -> None:
    """Refuse a bag whose recorder names another body or world: weights are of one of each.

    Args:
        bag: The bag; what it does not tell of itself is taken for what is expected.
        expected: By name, `body` or `world`.
        source: What has said what to expect, with `{}` for the name.

    Raises:
        BagError: If it names another one.
    """
    for what, wanted in expected.items():
        if (found := bag.about.get(what, wanted)) != wanted:
            raise BagError(f"{bag.path}: recorded with the {what} {found}, expected {wanted} ({source.format(what)})")


def _require_training_level(bag: Bag, episode: EpisodeTruthReading) -> None:
    if episode.difficulty == 0:
        raise BagError(
            f"{bag.path} holds an episode whose level comes from a file, which may be one for tests: "
            "expected generated levels"
        )
    if episode.seed not in TRAIN_SEEDS:
        raise BagError(
            f"{bag.path} holds an episode with seed {episode.seed}, which is not for training: expected seeds from "
            f"{TRAIN_SEEDS.start} on, which recorders use unless they are told otherwise"
        )


@dataclass
class ReadReport:
    """What reading met with."""

    ticks: int = 0
    episodes: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    """Ticks that were left out, by reason."""
    seeds: set[int] = field(default_factory=set)
    """Seeds of the generated levels."""


class EpisodeTick(NamedTuple):
    """A tick of an episode all of whose earlier ticks came before."""

    episode: EpisodeTruthReading
    """Its `step` is 0 where an episode begins."""
    values: tuple[Any, ...]
    """In the order of the topics wanted."""


def episode_ticks(
    bag: Bag,
    wanted: Sequence[Topic],
    report: ReadReport | None = None,
    *,
    endings: bool = False,
    allow_test_seeds: bool = False,
) -> Iterator[EpisodeTick]:
    """Yield the ticks of each episode of a bag from its first on, up to one that is missing.

    What is behind a missing tick is left out: without it nobody can tell what the modules remember.

    Args:
        bag: As `open_training_bag` returns it.
        wanted: Topics, with `topics.TRUE_EPISODE` among them.
        report: Counts what is read and left out.
        endings: Yield an episode's last tick as well, which no module answers: as `Bag.ticks`.
        allow_test_seeds: Yield episodes whose levels are not for training instead of refusing the bag.

    Raises:
        BagError: As `Bag.ticks`, or if an episode's level is not for training.
    """
    report = ReadReport() if report is None else report
    which = wanted.index(topics.TRUE_EPISODE)
    number, following = None, 0
    for tick in bag.ticks(wanted, endings=endings):
        reading: EpisodeTruthReading = tick.values[which]
        if not allow_test_seeds:
            _require_training_level(bag, reading)
        if reading.episode == number and (0 < reading.step < following or (reading.step, following) == (0, 1)):
            report.skipped["that stand there twice"] += 1  # as after a simulator that was killed offers its tick again
            continue
        if reading.step == 0:
            number, following = reading.episode, 0
            report.episodes += 1
            if reading.difficulty:
                report.seeds.add(reading.seed)
        if number is None:
            report.skipped["of an episode whose start is missing"] += 1
        elif reading.episode != number or reading.step != following:
            report.skipped["behind a gap"] += 1
            number = None
        else:
            following += 1
            report.ticks += 1
            yield EpisodeTick(reading, tick.values)


def episodes(
    bag: Bag, wanted: Sequence[Topic], *, allow_test_seeds: bool = False
) -> Iterator[list[tuple[Any, ...]]]:
    """Yield the ticks of each episode, in the order of the topics, from its start up to a tick that is missing.

    Args:
        bag: As `open_training_bag` returns it.
        wanted: Topics, with `topics.TRUE_EPISODE` among them.
        allow_test_seeds: As of `episode_ticks`.

    Raises:
        BagError: As `episode_ticks`.
    """
    found: list[tuple[Any, ...]] = []
    for reading, values in episode_ticks(bag, wanted, allow_test_seeds=allow_test_seeds):
        if reading.step == 0 and found:
            yield found
            found = []
        found.append(values)
    if found:
        yield found
