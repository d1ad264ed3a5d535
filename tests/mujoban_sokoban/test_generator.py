import hashlib
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_core.grid import DIFFICULTIES, GRID_SIZE, OFFSETS_RC
from mujoban_sokoban.generator import (
    FRESH_SEEDS,
    PLANNER_SEEDS,
    PLAY_SEEDS,
    SENSES_SEEDS,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    generate_batch,
    generate_level,
    generate_levels,
    seed_range,
)
from mujoban_sokoban.levels import stack_levels
from mujoban_sokoban.solver import Status, solve_batch

difficulties = st.sampled_from(sorted(DIFFICULTIES))


def digest() -> str:
    levels = [level for difficulty in DIFFICULTIES for level in generate_levels(difficulty, [0, 1, TRAIN_SEEDS[-1]])]
    return hashlib.sha256("\n".join(level.to_text() for level in levels).encode()).hexdigest()


@given(difficulties, st.integers(0, TRAIN_SEEDS[-1]))
@settings(max_examples=100)
def test_a_level_has_the_size_and_boxes_of_its_difficulty(difficulty, seed):
    level = generate_level(difficulty, seed)
    size, boxes = DIFFICULTIES[difficulty]
    assert len(level.boxes) == level.target.sum() == boxes
    rows, cols = np.nonzero(~level.wall)
    low = (GRID_SIZE - size) // 2
    assert min(rows.min(), cols.min()) > low
    assert max(rows.max(), cols.max()) < low + size - 1
    assert level.seed == seed


@given(difficulties, st.integers(0, TRAIN_SEEDS[-1]))
@settings(max_examples=50)
def test_no_level_starts_with_a_target_taken(difficulty, seed):
    level = generate_level(difficulty, seed)
    assert not level.target[level.boxes[:, 0], level.boxes[:, 1]].any()
    assert not level.target[level.player]


@pytest.mark.parametrize("difficulty", sorted(DIFFICULTIES))
def test_every_level_is_solvable(difficulty):
    solutions = solve_batch(generate_batch(difficulty, range(500)), weight=3.0)
    assert (solutions.status == Status.SOLVED).all()


def test_the_same_seed_gives_the_same_level_in_another_process():
    program = f"import sys; sys.path.insert(0, {sys.path[0]!r}); import importlib.util as u\n"
    program += f"s = u.spec_from_file_location('t', {__file__!r}); m = u.module_from_spec(s); s.loader.exec_module(m)\n"
    program += "print(m.digest())"
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest()


def test_a_seed_gives_the_level_that_it_gave_before():
    # Recorded results refer to seeds: whoever changes the generator invalidates them.
    assert digest() == "b4d7f746d4a3dfc8bd5153442af48e313ebc0f2c592343eea040c64d75d8c1d9"


def test_a_level_depends_on_nothing_but_its_seed():
    batch = generate_batch(5, [3, 1, 2])
    assert stack_levels([generate_level(5, seed) for seed in (3, 1, 2)]).wall.tolist() == batch.wall.tolist()


def test_seeds_give_different_levels():
    assert len(set(generate_levels(5, range(300)))) == 300


def test_train_and_test_seeds_are_apart():
    assert TEST_SEEDS[0] == 0 and TEST_SEEDS[-1] < VALIDATION_SEEDS[0] and VALIDATION_SEEDS[-1] < TRAIN_SEEDS[0]
    assert [seed_range(s) for s in (1000, VALIDATION_SEEDS[-1], TRAIN_SEEDS[0])] == ["test", "validation", "training"]
    with pytest.raises(ValueError, match=r"4999999 to 5000000: expected all in one range"):
        seed_range(TEST_SEEDS[-1], 2)
    kept_apart = [FRESH_SEEDS, SENSES_SEEDS, PLANNER_SEEDS, PLAY_SEEDS]
    assert all(before.stop <= after.start for before, after in pairwise(kept_apart))
    assert all(seed_range(seeds.start, len(seeds)) == "validation" for seeds in kept_apart)
    assert not set(generate_levels(5, TEST_SEEDS[:300])) & set(generate_levels(5, TRAIN_SEEDS[:300]))


def test_difficulty_5_is_as_spacious_as_boxoban():
    # Percentiles 5, 25, 50, 75, 95 of the floor cells of Boxoban's unfiltered set are 21, 27, 32, 36 and 42.
    floor = (~generate_batch(5, range(2000)).wall).sum((1, 2))
    assert np.abs(np.percentile(floor, [5, 25, 50, 75, 95]) - [21, 27, 32, 36, 42]).max() <= 1


def test_difficulty_5_is_as_hard_as_boxoban():
    # Nearly optimal solutions of Boxoban's unfiltered set average 32 moves with 13 pushes.
    solutions = solve_batch(generate_batch(5, range(1000)), weight=2.0)
    standard_error = solutions.length.std() / np.sqrt(len(solutions.length))
    assert solutions.length.mean() > 32 - 2 * standard_error
    assert solutions.length.mean() < 32 + 3 * standard_error
    assert abs(solutions.pushes.mean() - 13) < 1


def test_floor_is_one_room():
    for level in generate_levels(5, range(50)):
        reached, queue = {level.player}, [level.player]
        while queue:
            row, col = queue.pop()
            for step in OFFSETS_RC[1:]:
                cell = (row + int(step[0]), col + int(step[1]))
                if not level.wall[cell] and cell not in reached:
                    reached.add(cell)
                    queue.append(cell)
        assert len(reached) == (~level.wall).sum()


@pytest.mark.parametrize("difficulty", [0, 6, -1, 5.0])
def test_an_unknown_difficulty_is_refused(difficulty):
    with pytest.raises(ValueError, match=rf"unknown difficulty {difficulty}: expected one of 1, 2, 3, 4, 5"):
        generate_level(difficulty, 0)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed -1 is negative"):
        generate_level(5, -1)
