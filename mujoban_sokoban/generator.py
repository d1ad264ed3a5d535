"""Generated levels, after Racaniere et al. 2017 ("Imagination-Augmented Agents", appendix on Sokoban levels).

1. *Room*: a random walk carves floor with small patterns out of a solid block.
2. *Targets*: distinct random floor squares, with a box on each.
3. *Reverse play*: a random depth-first search pulls boxes backwards from that solved state; of the states that it
   visits, the level starts from the hardest one by the score (changes of the pulled box)^2 x (total displacement
   of boxes). Each start is reached from the solved state by pulls, so pushes solve it: every level is solvable.

One seed and difficulty give one level, on every machine.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from numbers import Integral
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_core.grid import DIFFICULTIES, GRID_SIZE, OFFSETS_RC
from mujoban_sokoban.bitboard import NONE, SIDE, SQUARES, Bits, Int, bit, count, flood, lowest, shift
from mujoban_sokoban.levels import Level, LevelBatch

TEST_SEEDS: Final = range(0, 5_000_000)
"""Seeds of results: never of training, and for tuning and playing there are others."""
VALIDATION_SEEDS: Final = range(5_000_000, 10_000_000)
"""Seeds for tuning: to be looked at as often as one likes."""
FRESH_SEEDS: Final = range(7_000_000, 8_000_000)
"""Those of validation by which no trainer chooses what it keeps: what `make weights` reports is measured on them."""
SENSES_SEEDS: Final = range(8_000_000, 9_000_000)
"""Those of validation that `make weights` records, to judge the senses on."""
PLANNER_SEEDS: Final = range(9_000_000, 9_500_000)
"""Those of validation by which the planner's trainers choose what they keep."""
PLAY_SEEDS: Final = range(9_500_000, 10_000_000)
"""Those of validation by which nothing is chosen: what is played where nobody gives a seed."""
TRAIN_SEEDS: Final = range(10_000_000, 2**62)
"""Seeds of training."""


def draw_training_seeds(rng: np.random.Generator, count: int) -> list[int]:
    """Return the seeds of `count` levels for training."""
    return rng.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop, count).tolist()


def seed_range(first: int, count: int = 1) -> str:
    """Return the range in which seeds from `first` on lie: test, validation or training.

    Raises:
        ValueError: if they do not all lie in one.
    """
    ranges = {"test": TEST_SEEDS, "validation": VALIDATION_SEEDS, "training": TRAIN_SEEDS}
    for name, seeds in ranges.items():
        if first in seeds and first + count - 1 in seeds:
            return name
    within = "; ".join(f"{name} {seeds.start} to {seeds.stop - 1}" for name, seeds in ranges.items())
    raise ValueError(f"seeds {first} to {first + count - 1}: expected all in one range ({within})")

# Carving patterns, the walker in the middle; those of Racaniere et al. as published in gym-sokoban.
_PATTERNS: Final = np.array(
    [
        [[0, 0, 0], [1, 1, 1], [0, 0, 0]],
        [[0, 1, 0], [0, 1, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [1, 1, 0]],
        [[0, 0, 0], [0, 1, 1], [0, 1, 0]],
    ],
    np.bool_,
)
# The walk and the reach of reverse play are tuned so that difficulty 5 has the statistics of Boxoban's unfiltered
# set, see docs/levels.md. The walker turns at a border, which makes rooms vary less in size than bumping into it.
_TURN_PROBABILITY: Final = 0.3
_STEPS_PER_SIDE: Final = 3.1
_REVERSE_STATES: Final = 700
"""States that reverse play visits at most."""
_TABLE_BITS: Final = 11


@njit(cache=True, nogil=True)
def _below(rng: np.random.Generator, n: Int) -> Int:
    """Draw uniformly from 0..n-1; from `random` alone, whose stream NumPy keeps stable."""
    return int(rng.random() * n)


@njit(cache=True, nogil=True)
def _carve_room(rng: np.random.Generator, size: Int) -> Bits:
    """Return the floor that a random walk carves into a grid of `size`, placed as a level text would be."""
    low = (GRID_SIZE - size) // 2
    side = size - 2
    row, col = _below(rng, side), _below(rng, side)
    direction = _below(rng, 4)
    floor = NONE
    for _ in range(int(_STEPS_PER_SIDE * size)):
        ahead_row, ahead_col = row + OFFSETS_RC[direction + 1, 0], col + OFFSETS_RC[direction + 1, 1]
        leaves = not (0 <= ahead_row < side and 0 <= ahead_col < side)
        if leaves or rng.random() < _TURN_PROBABILITY:
            direction = _below(rng, 4)
        row = min(max(row + OFFSETS_RC[direction + 1, 0], 0), side - 1)
        col = min(max(col + OFFSETS_RC[direction + 1, 1], 0), side - 1)
        pattern = _PATTERNS[_below(rng, len(_PATTERNS))]
        for i in range(3):
            for j in range(3):
                r, c = row + i - 1, col + j - 1
                if pattern[i, j] and 0 <= r < side and 0 <= c < side:
                    floor |= bit((r + low) * SIDE + c + low)
    return floor


@njit(cache=True, nogil=True)
def _random_square(rng: np.random.Generator, bits: Bits) -> Int:
    skip = _below(rng, count(bits))
    for _ in range(skip):
        bits &= bits - np.uint64(1)
    return lowest(bits)


@njit(cache=True, nogil=True)
def _insert(table_boxes: NDArray[np.uint64], table_player: NDArray[np.uint64], boxes: Bits, region: Bits) -> bool:
    """Add a state to an open-addressing set; false when it was there. An empty slot has no boxes."""
    mask = np.uint64(len(table_boxes) - 1)
    slot = ((boxes ^ (region * np.uint64(0xD6E8FEB86659FD93))) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)
    slot &= mask
    while table_boxes[slot] != NONE:
        if table_boxes[slot] == boxes and table_player[slot] == region:
            return False
        slot = (slot + np.uint64(1)) & mask
    table_boxes[slot], table_player[slot] = boxes, region
    return True


@njit(cache=True, nogil=True)
def _reverse_play(
    rng: np.random.Generator, floor: Bits, home: NDArray[np.int64], player: Int, boxes_out: NDArray[np.int64]
) -> Int:
    """Write the boxes of the hardest visited start to `boxes_out` [K]; return its player square, or -1 if none."""
    k_boxes = len(home)
    targets = NONE
    for k in range(k_boxes):
        targets |= bit(home[k])
    table_boxes = np.zeros(1 << _TABLE_BITS, np.uint64)
    table_player = np.zeros(1 << _TABLE_BITS, np.uint64)
    # A state of the stack: boxes, player, box pulled last, number of changes of the pulled box.
    capacity = _REVERSE_STATES + 4 * k_boxes
    stack = np.empty((capacity, k_boxes + 3), np.int64)
    stack[0, :k_boxes] = home
    stack[0, k_boxes], stack[0, k_boxes + 1], stack[0, k_boxes + 2] = player, -1, 0
    top, visited, best, best_player = 1, 1, 0, -1
    while top > 0:
        top -= 1
        state = stack[top].copy()
        position = state[:k_boxes]
        boxes = NONE
        displacement = 0
        for k in range(k_boxes):
            boxes |= bit(position[k])
            displacement += abs(position[k] // SIDE - home[k] // SIDE) + abs(position[k] % SIDE - home[k] % SIDE)
        score = state[k_boxes + 2] ** 2 * displacement
        if score > best and boxes & targets == NONE and targets & bit(state[k_boxes]) == NONE:
            best, best_player = score, state[k_boxes]
            boxes_out[:] = position
        free = floor & ~boxes
        region = flood(bit(state[k_boxes]), free)
        first = top
        for k in range(k_boxes):
            for direction in range(4):
                beside = shift(bit(position[k]), direction) & region
                beyond = shift(beside, direction) & free
                if beyond == NONE or visited >= _REVERSE_STATES:
                    continue
                pulled = (boxes & ~bit(position[k])) | beside
                after = flood(beyond, floor & ~pulled)
                if not _insert(table_boxes, table_player, pulled, bit(lowest(after))):
                    continue
                visited += 1
                stack[top] = state
                stack[top, k] = lowest(beside)
                stack[top, k_boxes] = lowest(beyond)
                stack[top, k_boxes + 1] = k
                stack[top, k_boxes + 2] += state[k_boxes + 1] != k
                top += 1
        for i in range(top - 1, first, -1):
            j = first + _below(rng, i - first + 1)
            for column in range(k_boxes + 3):
                stack[i, column], stack[j, column] = stack[j, column], stack[i, column]
    return best_player


@njit(cache=True, nogil=True)
def _generate(
    rng: np.random.Generator,
    size: Int,
    wall: NDArray[np.bool_],
    target: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
) -> None:
    """Write one level; draws rooms until one has a start."""
    k_boxes = len(boxes)
    home = np.empty(k_boxes, np.int64)
    start = np.empty(k_boxes, np.int64)
    while True:
        floor = _carve_room(rng, size)
        if count(floor) < 2 * k_boxes + 2:
            continue
        free = floor
        for k in range(k_boxes):
            home[k] = _random_square(rng, free)
            free &= ~bit(home[k])
        square = _reverse_play(rng, floor, home, _random_square(rng, free), start)
        if square >= 0:
            break
    wall[:], target[:] = True, False
    for s in range(SQUARES):
        wall[s // SIDE + 1, s % SIDE + 1] = floor & bit(s) == NONE
    start.sort()
    for k in range(k_boxes):
        target[home[k] // SIDE + 1, home[k] % SIDE + 1] = True
        boxes[k, 0], boxes[k, 1] = start[k] // SIDE + 1, start[k] % SIDE + 1
    player[0], player[1] = square // SIDE + 1, square % SIDE + 1


def check_difficulty(difficulty: int) -> None:
    """Raise a `ValueError` unless there are levels of this difficulty."""
    if difficulty not in DIFFICULTIES or not isinstance(difficulty, Integral):
        raise ValueError(f"unknown difficulty {difficulty!r}: expected one of {', '.join(map(str, DIFFICULTIES))}")


def check_seed(seed: int) -> None:
    """Raise a `ValueError` unless a seed can be that of an episode."""
    if seed < 0:
        raise ValueError(f"seed {seed} is negative: expected an integer from 0")


def _rng(difficulty: int, seed: int) -> np.random.Generator:
    check_seed(seed)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([difficulty, seed])))


def generate_batch(difficulty: int, seeds: Iterable[int]) -> LevelBatch:
    """Generate the levels of several seeds as arrays.

    Args:
        difficulty: key of `grid.DIFFICULTIES`.
        seeds: one non-negative integer a level.

    Raises:
        ValueError: If the difficulty is unknown or a seed is negative.
    """
    check_difficulty(difficulty)
    size, k_boxes = DIFFICULTIES[difficulty]
    seeds = [operator.index(seed) for seed in seeds]
    batch = LevelBatch(
        np.empty((len(seeds), GRID_SIZE, GRID_SIZE), np.bool_),
        np.empty((len(seeds), GRID_SIZE, GRID_SIZE), np.bool_),
        np.empty((len(seeds), k_boxes, 2), np.int64),
        np.empty((len(seeds), 2), np.int64),
    )
    for i, seed in enumerate(seeds):
        _generate(_rng(difficulty, seed), size, *(array[i] for array in batch))
    return batch


def generate_levels(difficulty: int, seeds: Sequence[int]) -> list[Level]:
    """Generate the levels of several seeds; see `generate_batch`."""
    batch = generate_batch(difficulty, seeds)
    return [
        Level(wall, target, boxes, (int(player[0]), int(player[1])), name=f"{difficulty}/{seed}", seed=int(seed))
        for wall, target, boxes, player, seed in zip(*batch, seeds, strict=True)
    ]


def generate_level(difficulty: int, seed: int) -> Level:
    """Generate the level of one seed; see `generate_batch`."""
    return generate_levels(difficulty, [seed])[0]
