"""Sokoban levels: one `Level` value, and the Boxoban text format in which levels are read and written.

A level file holds any number of levels, each a header ``; name`` (Boxoban numbers them from 0) and up to ten rows of
up to ten symbols. The header may be missing; a blank line then ends a level. Headers that `write_levels` writes end in
a seal, ``[level 1 of 8, sha256 ...]``, by which `read_levels` tells damage that leaves a level valid.

======  =================  ======  ====================
symbol  meaning            symbol  meaning
======  =================  ======  ====================
``#``   wall               ``.``   target
space   floor              ``*``   box on a target
``@``   player             ``+``   player on a target
``$``   box
======  =================  ======  ====================

Shapes: N = `grid.GRID_SIZE`, K boxes, B levels.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.files import write_atomically
from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE, TARGET, WALL

SYMBOLS: Final = "# @$.*+"
"""Every symbol that a level text may contain."""
_PLAYER_SYMBOLS: Final = "@+"
_BOX_SYMBOLS: Final = "$*"
_TARGET_SYMBOLS: Final = ".*+"
_DIGITS: Final = 16
_SEAL: Final = re.compile(rf" \[level \d+ of \d+, sha256 [0-9a-f]{{{_DIGITS}}}\]$")
_BROKEN: Final = (
    "name, rows, place or number of levels are not what its header's seal says: expected the file as it was written "
    "(to edit it, take '[level ...]' out of all headers)"
)


class LevelError(ValueError):
    """A level or level file is malformed; the message names it and what was expected."""


@dataclass(frozen=True, eq=False)
class Level:
    """A Sokoban level, padded with wall to the full grid. Equal levels have equal contents; names do not count.

    Attributes:
        wall: where walls are, bool [N, N]; everything that nothing can reach is wall.
        target: where targets are, bool [N, N].
        boxes: (row, column) of every box, sorted, int64 [K, 2].
        player: (row, column) of the player.
        name: the header of its text, for people.
        seed: the seed that generated it; None for a level from a file.

    Raises:
        LevelError: If boxes and targets differ in number, there is no box, something stands in a wall or on
            something else, or the boundary is open.
    """

    wall: NDArray[np.bool_]
    target: NDArray[np.bool_]
    boxes: NDArray[np.int64]
    player: tuple[int, int]
    name: str = ""
    seed: int | None = None

    def __post_init__(self) -> None:
        boxes = np.asarray(self.boxes, np.int64).reshape(-1, 2)
        target = np.array(self.target, np.bool_)
        wall = np.array(self.wall, np.bool_)
        if wall.shape != (GRID_SIZE, GRID_SIZE) or target.shape != wall.shape:
            raise LevelError(
                f"wall and target of shapes {wall.shape} and {target.shape}: expected ({GRID_SIZE}, {GRID_SIZE})"
            )
        boxes = boxes[np.lexsort((boxes[:, 1], boxes[:, 0]))]
        wall = ~_enclosed(wall, target, boxes, self.player)
        for array in (wall, target, boxes):
            array.setflags(write=False)
        object.__setattr__(self, "wall", wall)
        object.__setattr__(self, "target", target)
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "player", (int(self.player[0]), int(self.player[1])))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Level) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[bytes, bytes, bytes, tuple[int, int]]:
        return self.wall.tobytes(), self.target.tobytes(), self.boxes.tobytes(), self.player

    def abstract_state(self) -> NDArray[np.float32]:
        """Return s_abst of the level's start, binary, [N, N, 4] in the order of `grid.CHANNELS`."""
        state = np.zeros((GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32)
        state[..., WALL] = self.wall
        state[..., TARGET] = self.target
        state[(*self.player, AGENT)] = 1.0
        state[self.boxes[:, 0], self.boxes[:, 1], BOX] = 1.0
        return state

    @classmethod
    def from_text(cls, text: str, name: str = "") -> Level:
        """Read one level from its rows, north first; rows of a smaller grid are centred and padded with wall.

        Raises:
            LevelError: If the text is not a level; says what was expected.
        """
        rows = [line.rstrip("\r") for line in text.split("\n")]
        while rows and not rows[-1].strip():
            rows.pop()
        while rows and not rows[0].strip():
            rows.pop(0)
        return cls(*_parse_rows(rows), name=name)

    def to_text(self) -> str:
        """Return the level's N rows of N symbols, without a final newline."""
        grid = np.where(self.wall, "#", np.where(self.target, ".", " "))
        for row, col in self.boxes:
            grid[row, col] = "*" if self.target[row, col] else "$"
        grid[self.player] = "+" if self.target[self.player] else "@"
        return "\n".join("".join(row) for row in grid)


class LevelBatch(NamedTuple):
    """Levels, or states on the way through them, as arrays for batched consumers."""

    wall: NDArray[np.bool_]
    """[B, N, N]."""
    target: NDArray[np.bool_]
    """[B, N, N]."""
    boxes: NDArray[np.int64]
    """(row, column), [B, K, 2]; (-1, -1) where a level has fewer than K."""
    player: NDArray[np.int64]
    """(row, column), [B, 2]."""


def stack_levels(levels: Sequence[Level]) -> LevelBatch:
    """Return levels as one batch; K is the largest number of boxes."""
    boxes = np.full((len(levels), max((len(level.boxes) for level in levels), default=0), 2), -1, np.int64)
    for row, level in zip(boxes, levels, strict=True):
        row[: len(level.boxes)] = level.boxes
    shape = (len(levels), GRID_SIZE, GRID_SIZE)
    return LevelBatch(
        np.array([level.wall for level in levels], np.bool_).reshape(shape),
        np.array([level.target for level in levels], np.bool_).reshape(shape),
        boxes,
        np.array([level.player for level in levels], np.int64).reshape(-1, 2),
    )


def walls_around(wall: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether the edge of each grid, [..., N, N], is wall throughout, [...]."""
    inner = wall[..., 1:-1, 1:-1]
    return wall.sum((-2, -1)) - inner.sum((-2, -1)) == 4 * (GRID_SIZE - 1)


def read_levels(path: str | PathLike[str]) -> list[Level]:
    """Read every level of a file in the Boxoban format.

    Raises:
        LevelError: If the file or a level is malformed; names the file, the level and what was expected.
        OSError: If the file cannot be read.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise LevelError(f"{path}: not a text file: expected levels of the symbols {SYMBOLS!r}") from error
    levels = []
    texts = list(_split(lines))
    sealed = any(_SEAL.search(header) for header, _ in texts)
    for index, (header, rows) in enumerate(texts):
        name = _SEAL.sub("", header)
        try:
            if sealed and header != _seal(name, rows, index, len(texts)):
                raise LevelError(_BROKEN)
            levels.append(Level(*_parse_rows(rows), name=name))
        except LevelError as error:
            raise LevelError(f"{path}: level {name or index}: {error}") from None
    if not levels:
        raise LevelError(f"{path}: no levels: expected '; n' followed by rows of the symbols {SYMBOLS!r}")
    return levels


def write_levels(path: str | PathLike[str], levels: Iterable[Level]) -> None:
    """Write levels in the Boxoban format; a level without a name gets its index. Headers carry seals.

    Raises:
        LevelError: If a name spans lines, which the format cannot hold.
        OSError: If the file cannot be written; the old one stays as it was.
    """
    texts = []
    levels = list(levels)
    for index, level in enumerate(levels):
        name = level.name.strip() or str(index)
        if len(name.splitlines()) != 1:
            raise LevelError(f"level {index}: name {name!r} spans lines: expected one line")
        text = level.to_text()
        texts.append(f"; {_seal(name, text.splitlines(), index, len(levels))}\n{text}\n")
    write_atomically(Path(path), "\n".join(texts).encode())


def _seal(name: str, rows: Sequence[str], index: int, count: int) -> str:
    """Return the header of a level in a file of `count`: its name, its place, and a checksum of name and rows."""
    digest = hashlib.sha256("\n".join([name, *rows]).encode()).hexdigest()
    return f"{name} [level {index + 1} of {count}, sha256 {digest[:_DIGITS]}]"


def _split(lines: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield the header and the rows of each level of a file."""
    name: str | None = None
    rows: list[str] = []
    for line in [*lines, ";"]:
        header = line.startswith(";")
        if header or not line.strip():
            if rows or (header and name is not None):
                yield name or "", rows
                name, rows = None, []
            if header:
                name = line[1:].strip()
        else:
            rows.append(line)


Contents = tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64], tuple[int, int]]


def _parse_rows(rows: Sequence[str]) -> Contents:
    """Return wall, target, boxes and player of a level's rows, padded to the full grid."""
    if not rows:
        raise LevelError(f"no rows: expected rows of the symbols {SYMBOLS!r}")
    height, width = len(rows), max(len(row.rstrip()) for row in rows)
    if height > GRID_SIZE or width > GRID_SIZE:
        raise LevelError(f"{height} rows of {width} columns: expected at most {GRID_SIZE} of {GRID_SIZE}")
    for number, row in enumerate(rows):
        for symbol in row:
            if symbol not in SYMBOLS:
                raise LevelError(f"unknown symbol {symbol!r} in row {number}: expected one of {SYMBOLS!r}")
    symbols = np.array([list(row.rstrip().ljust(width)) for row in rows])
    players = np.argwhere(np.isin(symbols, list(_PLAYER_SYMBOLS)))
    if len(players) != 1:
        raise LevelError(f"{len(players) or 'no'} players: expected exactly one '@' or '+'")
    wall, target = symbols == "#", np.isin(symbols, list(_TARGET_SYMBOLS))
    boxes = np.argwhere(np.isin(symbols, list(_BOX_SYMBOLS)))
    # Padding would close an opening in the text's own edge, so look for one before.
    _enclosed(wall, target, boxes, (players[0, 0], players[0, 1]))
    shift = ((GRID_SIZE - height) // 2, (GRID_SIZE - width) // 2)
    frame = (slice(shift[0], shift[0] + height), slice(shift[1], shift[1] + width))
    padded_wall = np.ones((GRID_SIZE, GRID_SIZE), np.bool_)
    padded_target = np.zeros_like(padded_wall)
    padded_wall[frame], padded_target[frame] = wall, target
    player = (int(players[0, 0]) + shift[0], int(players[0, 1]) + shift[1])
    return padded_wall, padded_target, boxes + np.array(shift), player


def _check_contents(
    wall: NDArray[np.bool_], target: NDArray[np.bool_], boxes: NDArray[np.int64], player: tuple[int, int]
) -> None:
    """Raise a `LevelError` unless boxes match targets and everything stands on floor of its own."""
    if len(boxes) == 0:
        raise LevelError("no boxes: expected at least one '$' or '*'")
    if len(boxes) != target.sum():
        raise LevelError(f"{len(boxes)} boxes and {target.sum()} targets: expected as many boxes as targets")
    taken = {(int(row), int(col)) for row, col in [*boxes, player]}
    if len(taken) != len(boxes) + 1:
        raise LevelError("two things in one cell: expected boxes and player in cells of their own")
    size = np.array(wall.shape)
    for cell in taken:
        if (np.array(cell) < 0).any() or (np.array(cell) >= size).any() or wall[cell]:
            raise LevelError(f"box or player at {cell}: expected a floor cell of the grid")
    if (wall & target).any():
        raise LevelError("target in a wall: expected targets on floor cells")


def _enclosed(
    wall: NDArray[np.bool_], target: NDArray[np.bool_], boxes: NDArray[np.int64], player: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return the floor that is connected to player, boxes or targets, bool like `wall`.

    Raises:
        LevelError: If the contents are malformed, or that floor reaches the edge of the array.
    """
    _check_contents(wall, target, boxes, player)
    inside = target.copy()
    inside[boxes[:, 0], boxes[:, 1]] = True
    inside[player] = True
    count = 0
    while count != (count := int(inside.sum())):
        inside[1:] |= inside[:-1]
        inside[:-1] |= inside[1:]
        inside[:, 1:] |= inside[:, :-1]
        inside[:, :-1] |= inside[:, 1:]
        inside &= ~wall
    edge = np.ones_like(wall)
    edge[1:-1, 1:-1] = False
    if (inside & edge).any():
        row, col = np.argwhere(inside & edge)[0]
        raise LevelError(f"open boundary at row {row}, column {col}: expected walls all around")
    return inside
