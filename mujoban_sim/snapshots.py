"""What a world's rows need to go on elsewhere: a flat dict of arrays, M rows on the first axis of each.

`mujoban_sim.world.World.snapshot` and `restore` make and take them. They hold numbers only, so safetensors carry them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level

Snapshot = Mapping[str, NDArray[Any]]
"""Arrays by name, each [M, ...]."""

_LEVEL, _SEED, _LEVEL_SEED = "episode.level", "episode.seed", "episode.level_seed"
_NO_SEED: Final = -1


def encode_episodes(episodes: Sequence[EpisodeSpec | None]) -> dict[str, NDArray[Any]]:
    """Return episodes as arrays: level texts as bytes, [M, L], and seeds, [M].

    Raises:
        ValueError: if one is None.
    """
    specs = [episode for episode in episodes if episode is not None]
    if len(specs) != len(episodes):
        raise ValueError("rows without an episode have no snapshot: call reset first")
    levels = [spec.level for spec in specs]
    texts = b"".join(level.to_text().encode() for level in levels)
    return {
        _LEVEL: np.frombuffer(texts, np.uint8).reshape(len(specs), -1).copy(),
        _SEED: np.array([spec.seed for spec in specs], np.int64),
        _LEVEL_SEED: np.array([_NO_SEED if level.seed is None else level.seed for level in levels], np.int64),
    }


def decode_episodes(snapshot: Snapshot) -> list[EpisodeSpec]:
    """Return the episodes of a snapshot; names of levels are not kept.

    Raises:
        ValueError: if a level is malformed.
    """
    levels = [Level.from_text(row.tobytes().decode("ascii", "replace")) for row in snapshot[_LEVEL]]
    generated = [None if seed == _NO_SEED else seed for seed in snapshot[_LEVEL_SEED].tolist()]
    return [
        EpisodeSpec(replace(level, seed=origin), seed)
        for level, origin, seed in zip(levels, generated, snapshot[_SEED].tolist(), strict=True)
    ]


def check_snapshot(
    snapshot: Snapshot, rows: int, arrays: Mapping[str, NDArray[Any]], ranges: Mapping[str, tuple[int, int]]
) -> None:
    """Reject what is not a snapshot of so many rows of these arrays, and of episodes besides.

    Args:
        snapshot: What is to be checked.
        rows: M.
        arrays: Those of a world, each [B, ...].
        ranges: Least and greatest value of those by which kernels, which check nothing, find their way.

    Raises:
        ValueError: if an array is missing, has another shape or type, is not finite or is out of its range.
    """
    seeds = np.empty(0, np.int64)
    for name, like in {**arrays, _SEED: seeds, _LEVEL_SEED: seeds}.items():
        if name not in snapshot:
            raise ValueError(f"the snapshot lacks {name}")
        array, shape = snapshot[name], (rows, *like.shape[1:])
        if (array.shape, array.dtype) != (shape, like.dtype) or not np.isfinite(array).all():
            raise ValueError(
                f"{name} of the snapshot is {array.dtype} of shape {array.shape}: "
                f"expected {like.dtype} of {shape}, all finite"
            )
    for name, (least, most) in ranges.items():
        if ((snapshot[name] < least) | (snapshot[name] > most)).any():
            raise ValueError(f"{name} of the snapshot: expected {least} to {most}")
    if _LEVEL not in snapshot or snapshot[_LEVEL].shape[:1] != (rows,) or snapshot[_LEVEL].dtype != np.uint8:
        raise ValueError(f"the snapshot lacks {_LEVEL}: expected level texts as bytes")


class Portable:
    """A world that `copy.deepcopy` and pickle carry: by what made it and a snapshot of its episodes.

    Physics and OpenGL, which cannot be carried, are made anew; the copy continues to the last bit.
    """

    _made_of: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Note what the world is made of."""
        world = super().__new__(cls)
        world._made_of = args, kwargs
        return world

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make an equal world."""
        world: Any = self
        rows = [row for row, episode in enumerate(world.episodes) if episode is not None]
        return _make_again, (type(self), *self._made_of, rows, world.snapshot(rows) if rows else {})


def _make_again(
    kind: type[Any], args: tuple[Any, ...], kwargs: dict[str, Any], rows: list[int], snapshot: Snapshot
) -> Any:
    world = kind(*args, **kwargs)
    if rows:
        world.restore(rows, snapshot)
    return world
