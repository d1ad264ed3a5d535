import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_core.grid import Instruction
from mujoban_sokoban.generator import generate_batch, generate_level
from mujoban_sokoban.levels import Level
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD, apply

OPPOSITE = {
    Instruction.NORTH: Instruction.SOUTH,
    Instruction.SOUTH: Instruction.NORTH,
    Instruction.EAST: Instruction.WEST,
    Instruction.WEST: Instruction.EAST,
}
instructions = st.lists(st.sampled_from(list(Instruction)), min_size=1, max_size=60)
levels = st.builds(generate_level, st.integers(1, 5), st.integers(0, 1000))


@given(levels, instructions)
@settings(max_examples=150)
def test_play_keeps_the_invariants(level, plan):
    boxes, player, total = level.boxes, np.array(level.player), 0.0
    for instruction in plan:
        on_before = int(level.target[boxes[:, 0], boxes[:, 1]].sum())
        after = apply(level.wall, level.target, boxes, player, instruction)
        cells = {tuple(cell) for cell in [*after.boxes.tolist(), after.player.tolist()]}
        assert len(cells) == len(level.boxes) + 1
        assert not any(level.wall[cell] for cell in cells)
        assert after.moved == (after.player != player).any()
        pushed = (after.boxes != boxes).any(-1)
        assert pushed.sum() <= after.moved
        if pushed.any():
            assert np.array_equal(after.player, boxes[pushed][0])
        if instruction == Instruction.STAY:
            assert not after.moved
        on_after = int(level.target[after.boxes[:, 0], after.boxes[:, 1]].sum())
        assert after.solved == (on_after == len(boxes))
        gained = SOLVED_REWARD if on_after == len(boxes) > on_before else 0.0
        assert after.reward == BOX_REWARD * (on_after - on_before) + gained
        if after.moved and not pushed.any():
            back = apply(level.wall, level.target, after.boxes, after.player, OPPOSITE[instruction])
            assert np.array_equal(back.player, player)
            assert np.array_equal(back.boxes, boxes)
        boxes, player, total = after.boxes, after.player, total + float(after.reward)


@given(st.integers(0, 1000), st.randoms(use_true_random=False))
@settings(max_examples=30)
def test_a_batch_is_its_levels_one_by_one(seed, random):
    batch = generate_batch(4, range(seed, seed + 8))
    plan = np.array([random.randrange(5) for _ in range(8)])
    together = apply(*batch, plan)
    for i in range(8):
        alone = apply(*(array[i] for array in batch), plan[i])
        for got, expected in zip((array[i] for array in together), alone, strict=True):
            assert np.array_equal(got, expected)


def test_a_push_onto_the_last_target_pays_box_and_solution():
    level = Level.from_text("######\n#@$. #\n######")
    after = apply(level.wall, level.target, level.boxes, level.player, Instruction.EAST)
    assert (after.reward, after.solved, after.moved) == (11.0, True, True)
    off = apply(level.wall, level.target, after.boxes, after.player, Instruction.EAST)
    assert (off.reward, off.solved) == (-1.0, False)


@pytest.mark.parametrize("text", ["####\n#@*#\n####", "#####\n#@**#\n#####", "#####\n#@$##\n#.  #\n#####"])
def test_a_box_against_a_wall_or_a_box_does_not_move(text):
    level = Level.from_text(text)
    after = apply(level.wall, level.target, level.boxes, level.player, Instruction.EAST)
    assert not after.moved
    assert np.array_equal(after.boxes, level.boxes)


def test_absent_boxes_change_nothing():
    level = Level.from_text("######\n#@$. #\n######")
    padded = np.concatenate([level.boxes, [[-1, -1]]])
    after = apply(level.wall, level.target, padded, level.player, Instruction.EAST)
    assert after.solved
    assert after.boxes[1].tolist() == [-1, -1]


def test_a_box_that_an_estimate_has_in_a_wall_does_not_move():
    level = Level.from_text("######\n#@$. #\n######")
    wall = level.wall.copy()
    wall[tuple(level.boxes[0])] = True
    assert not apply(wall, level.target, level.boxes, level.player, Instruction.EAST).moved


def test_what_an_estimate_has_on_the_outermost_cells_is_ignored():
    level = Level.from_text("######\n#@$. #\n######")
    boxes = np.concatenate([level.boxes, [[0, 0], [9, 5]]])
    after = apply(level.wall, level.target, boxes, level.player, Instruction.EAST)
    assert after.solved and after.boxes[1:].tolist() == [[0, 0], [9, 5]]
    for corner in ([0, 4], [9, 9]):
        assert not apply(~level.wall, level.target, boxes, corner, Instruction.SOUTH).moved


@pytest.mark.parametrize("bad", [-1, 5])
def test_an_unknown_instruction_is_refused(bad):
    with pytest.raises(ValueError, match=r"0\.\.4"):
        apply(*generate_batch(1, [0]), np.array([bad]))


def test_shapes_that_do_not_fit_are_refused():
    batch = generate_batch(1, [0, 1])
    with pytest.raises(ValueError, match="expected"):
        apply(batch.wall, batch.target, batch.boxes, batch.player[:1], np.zeros(2, np.int64))
