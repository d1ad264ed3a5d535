import subprocess
import sys
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_core.grid import Instruction
from mujoban_sokoban.generator import generate_batch, generate_level
from mujoban_sokoban.levels import Level, LevelBatch, stack_levels
from mujoban_sokoban.rules import apply
from mujoban_sokoban.solver import (
    Status,
    demonstrations,
    label_states,
    solve,
    solve_batch,
    solve_level,
    solve_levels,
)
from mujoban_sokoban.solver_labels import ABSENT


def key(boxes, player):
    return (tuple(sorted(map(tuple, boxes.tolist()))), tuple(player.tolist()))


def fewest_moves(level: Level) -> int | None:
    """Breadth-first search over the rules, the plainest solver there is; None if unsolvable."""
    start = (level.boxes, np.array(level.player))
    queue, seen = deque([(start, 0)]), {key(*start)}
    if level.target[level.boxes[:, 0], level.boxes[:, 1]].all():
        return 0
    walls, targets = np.repeat(level.wall[None], 5, 0), np.repeat(level.target[None], 5, 0)
    while queue:
        (boxes, player), depth = queue.popleft()
        after = apply(walls, targets, np.repeat(boxes[None], 5, 0), np.repeat(player[None], 5, 0), np.arange(5))
        for instruction in range(1, 5):
            state = (after.boxes[instruction], after.player[instruction])
            if key(*state) in seen:
                continue
            if after.solved[instruction]:
                return depth + 1
            seen.add(key(*state))
            queue.append((state, depth + 1))
    return None


def play(level: Level, moves) -> bool:
    boxes, player, solved = level.boxes, np.array(level.player), False
    for move in moves:
        boxes, player, _, solved, moved = apply(level.wall, level.target, boxes, player, int(move))
        assert moved
    return bool(solved)


@st.composite
def small_levels(draw):
    """Rooms of up to 4 x 4 with one to three boxes anywhere, many of them unsolvable."""
    height, width = draw(st.integers(1, 4)), draw(st.integers(3, 4))
    cells = [(r, c) for r in range(height) for c in range(width)]
    boxes = draw(st.integers(1, min(3, len(cells) - 2)))
    walls = set(draw(st.permutations(cells))[: draw(st.integers(0, len(cells) - 1 - boxes))])
    free = [cell for cell in cells if cell not in walls]
    things = draw(st.permutations(free))
    targets = set(draw(st.permutations(free))[:boxes])
    wall, target = np.ones((10, 10), bool), np.zeros((10, 10), bool)
    corner = np.array([draw(st.integers(1, 9 - height)), draw(st.integers(1, 9 - width))])
    for cell in free:
        wall[tuple(corner + cell)], target[tuple(corner + cell)] = False, cell in targets
    return Level(wall, target, np.array(things[:boxes]) + corner, tuple(np.array(things[boxes]) + corner))


@given(small_levels())
@settings(max_examples=200)
def test_solutions_are_as_short_as_breadth_first_search_and_unsolvable_means_so(level):
    expected = fewest_moves(level)
    solution = solve_level(level)
    if expected is None:
        assert solution.status == Status.UNSOLVABLE
        assert len(solution.moves) == 0
    else:
        assert solution.status == Status.SOLVED
        assert len(solution.moves) == expected
        assert expected == 0 or play(level, solution.moves)


@given(st.integers(1, 3), st.integers(0, 10_000))
@settings(max_examples=25)
def test_generated_levels_are_solved_as_short_as_breadth_first_search(difficulty, seed):
    level = generate_level(difficulty, seed)
    solution = solve_level(level)
    assert play(level, solution.moves)
    assert len(solution.moves) == fewest_moves(level)


def test_solutions_of_difficulty_5_solve_their_levels():
    for seed in range(40):
        level = generate_level(5, seed)
        solution = solve_level(level)
        assert solution.status == Status.SOLVED
        assert play(level, solution.moves)
        boxes, player, pushes = level.boxes, np.array(level.player), 0
        for move in solution.moves:
            after = apply(level.wall, level.target, boxes, player, int(move))
            pushes += bool((after.boxes != boxes).any())
            boxes, player = after.boxes, after.player
        assert pushes == solution.pushes


def test_a_weight_bounds_how_much_longer_solutions_get():
    batch = generate_batch(5, range(100))
    optimal, quick = solve_batch(batch), solve_batch(batch, weight=2.0)
    assert (quick.length >= optimal.length).all()
    assert (quick.length <= 2 * optimal.length).all()
    assert quick.nodes.sum() < optimal.nodes.sum()


@pytest.mark.parametrize("count", [1, 5, 6, 7, 8, 9, 12])
def test_any_number_of_boxes_is_solved(count):
    rows = [["#", *" " * 8, "#"] for _ in range(8)]
    for k in range(count):
        rows[2 + 3 * (k // 7)][2 + k % 7 if k % 7 < 6 else 7] = "$"
        rows[1 + 6 * (k // 7)][2 + k % 7 if k % 7 < 6 else 7] = "."
    boxes = sum(row.count("$") for row in rows)
    rows[4][1] = "@"
    level = Level.from_text("\n".join(["#" * 10, *("".join(row) for row in rows), "#" * 10]))
    assert len(level.boxes) == boxes
    assert play(level, solve_level(level, weight=3.0).moves)


@pytest.mark.parametrize(
    "text",
    [
        "#####\n#@ .#\n#$  #\n#####",
        "######\n#@   #\n# $$ #\n# $$ #\n#....#\n######",
        "#######\n#@ #$.#\n#  ####\n# $  .#\n#######",
    ],
)
def test_dead_levels_are_proven_unsolvable(text):
    assert solve_level(Level.from_text(text)).status == Status.UNSOLVABLE


def test_a_solved_level_needs_no_moves():
    solution = solve_level(Level.from_text("#####\n#@* #\n#####"))
    assert (solution.status, len(solution.moves), solution.pushes) == (Status.SOLVED, 0, 0)


def test_running_out_of_nodes_is_not_called_unsolvable():
    assert solve_level(generate_level(5, 0), max_nodes=5).status == Status.BUDGET


def test_levels_with_different_numbers_of_boxes_share_a_batch():
    levels = [generate_level(difficulty, 1) for difficulty in range(1, 6)]
    together = solve_levels(levels)
    assert together.length.tolist() == [len(solve_level(level).moves) for level in levels]


def test_demonstrations_lead_to_the_solution():
    levels = [generate_level(difficulty, seed) for seed in range(12) for difficulty in (2, 5)]
    batch = stack_levels(levels)
    shown = demonstrations(batch, rng=np.random.default_rng(0))
    optimal = solve_batch(batch)
    for i, level in enumerate(levels):
        rows = np.flatnonzero(shown.level == i)
        assert shown.steps_to_go[rows].tolist() == list(range(optimal.length[i], 0, -1))
        boxes, player = batch.boxes[i], batch.player[i]
        for n, row in enumerate(rows):
            assert divmod(int(shown.player[row]), 10) == tuple(player)
            assert [divmod(int(b), 10) for b in shown.boxes[row] if b != ABSENT] == [
                tuple(b) for b in boxes if b[0] >= 0
            ]
            followers = []
            for instruction in np.flatnonzero(shown.optimal[row]):
                assert instruction != Instruction.STAY
                after = apply(level.wall, level.target, boxes, player, instruction)
                assert after.moved
                followers.append(after)
            if n + 1 == len(rows):
                assert any(after.solved for after in followers)
                break
            following = divmod(int(shown.player[rows[n + 1]]), 10)
            boxes, player = next((a.boxes, a.player) for a in followers if tuple(a.player) == following)


@given(st.integers(0, 10_000))
@settings(max_examples=15)
def test_every_instruction_called_optimal_is(seed):
    batch = generate_batch(4, [seed])
    labels = label_states(batch)
    single = tuple(array[0] for array in batch)
    assert labels.steps_to_go[0] == len(solve(*single).moves)
    for instruction in np.flatnonzero(labels.optimal[0]):
        after = apply(*single, instruction)
        rest = solve(single[0], single[1], after.boxes, after.player)
        assert len(rest.moves) == labels.steps_to_go[0] - 1


def test_the_plan_tells_the_next_push_out_of_each_cell():
    level = Level.from_text("#######\n#     #\n#@$   #\n#    .#\n#######")
    labels = label_states(stack_levels([level]))
    rows, cols = np.nonzero(labels.plan[0])
    plan = {
        (int(r - level.player[0]), int(c - level.player[1])): int(labels.plan[0, r, c])
        for r, c in zip(rows, cols, strict=True)
    }
    assert labels.status[0] == Status.SOLVED
    assert len(plan) == 4
    assert plan[(0, 1)] == Instruction.EAST
    assert sorted(plan.values()) == [Instruction.EAST] * 3 + [Instruction.SOUTH]


def test_the_plan_forgets_pushes_that_are_done():
    batch = generate_batch(5, [4])
    shown = demonstrations(batch, rng=np.random.default_rng(0))
    cells = (shown.plan > 0).sum((1, 2))
    assert (np.diff(cells) <= 0).all()
    assert cells[-1] == 1


def test_dead_states_are_flagged_and_have_no_labels():
    dead = Level.from_text("######\n#$@ .#\n#    #\n######")
    alive = Level.from_text("######\n# @$.#\n#    #\n######")
    labels = label_states(stack_levels([dead, alive]))
    assert labels.status.tolist() == [Status.UNSOLVABLE, Status.SOLVED]
    assert not labels.optimal[0].any()
    assert not labels.plan[0].any()
    assert labels.optimal[1].tolist() == [False, False, True, False, False]


def test_the_same_generator_state_gives_the_same_demonstrations():
    batch = generate_batch(5, range(5))
    first, second = (demonstrations(batch, rng=np.random.default_rng(3)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_compiled_code_is_shared_by_concurrent_processes():
    program = f"import sys; sys.path.insert(0, {sys.path[0]!r})\n"
    program += "from mujoban_sokoban.generator import generate_level; from mujoban_sokoban.solver import solve_level\n"
    program += "print(len(solve_level(generate_level(5, 1)).moves))"
    running = [subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    answers = {process.communicate(timeout=100)[0].strip() for process in running}
    assert answers == {str(len(solve_level(generate_level(5, 1)).moves))}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"wall": np.zeros((1, 10, 10), bool)}, "open boundary"),
        ({"player": np.array([[0, 0]])}, "player outside"),
        ({"boxes": np.array([[[-1, -1]]])}, "without boxes"),
        ({"target": np.zeros((1, 10, 10), bool)}, "expected as many"),
        ({"player": np.zeros((2, 2), np.int64)}, r"\[B, 2\]"),
    ],
)
def test_a_malformed_state_is_refused(change, expected):
    batch = generate_batch(1, [0])._replace(**change)
    with pytest.raises(ValueError, match=expected):
        solve_batch(LevelBatch(*batch))


def test_options_out_of_range_are_refused():
    batch = generate_batch(1, [0])
    with pytest.raises(ValueError, match="weight"):
        solve_batch(batch, weight=0.5)
    with pytest.raises(ValueError, match="max_nodes"):
        solve_batch(batch, max_nodes=0)
