"""The pushes of a way, in the order in which the robot walks least."""

import numpy as np
import pytest

from mujoban_planner.boards import bit_boards, take_levels
from mujoban_planner.shortening import shorten
from mujoban_sokoban.bitboard import SQUARE_STEP
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.levels import Level, stack_levels
from mujoban_sokoban.solver import label_solutions, solve

EAST = 1
"""Direction of a push: north, east, south, west."""


def length_and_end(levels, pushes):
    """Return the moves of a way, all of whose walks there are, and the boxes at its end."""
    found = label_solutions(levels, [pushes], rng=np.random.default_rng(0))
    box = int(bit_boards(levels).box[0])
    for push in pushes.tolist():
        square, direction = divmod(push, 4)
        assert box >> square & 1, "there is a box to push"
        box ^= 1 << square | 1 << square + int(SQUARE_STEP[direction])
    return int(found.steps_to_go[0]), box


def pushes_of(levels, moves):
    """Return the pushes among a solution's moves."""
    boards = bit_boards(levels)
    box, agent, pushes = int(boards.box[0]), int(boards.agent[0]), []
    for move in moves.tolist():
        ahead = agent + int(SQUARE_STEP[move - 1])
        if box >> ahead & 1:
            pushes.append(4 * ahead + move - 1)
            box ^= 1 << ahead | 1 << ahead + int(SQUARE_STEP[move - 1])
        agent = ahead
    return np.array(pushes, np.uint8)


def start(levels):
    boards = bit_boards(levels)
    return boards.wall[0], boards.box[0], int(boards.agent[0])


def test_two_boxes_that_were_pushed_in_turns_are_pushed_one_after_the_other():
    level = Level.from_text("########\n#@$  .##\n#      #\n#      #\n# $  . #\n########")
    levels = stack_levels([level])
    near, far = (np.flatnonzero([int(bit_boards(levels).box[0]) >> s & 1 for s in range(64)])[i] for i in (0, 1))
    in_turns = np.array([4 * (box + i) + EAST for i in range(3) for box in (near, far)], np.uint8)
    shorter = shorten(*start(levels), in_turns)
    assert shorter.tolist() == [*(4 * (near + i) + EAST for i in range(3)), *(4 * (far + i) + EAST for i in range(3))]
    best = solve(level.wall, level.target, level.boxes, level.player).moves
    assert length_and_end(levels, shorter)[0] == len(best) < length_and_end(levels, in_turns)[0]


def test_a_shorter_order_ends_where_the_way_does_and_never_walks_more():
    batch, gained = generate_batch(5, range(24)), 0
    for i in range(24):
        levels = take_levels(batch, np.array([i]))
        hasty = solve(levels.wall[0], levels.target[0], levels.boxes[0], levels.player[0], weight=5.0).moves
        pushes = pushes_of(levels, hasty)
        before, after = length_and_end(levels, pushes), length_and_end(levels, shorten(*start(levels), pushes))
        assert before[0] == len(hasty) and after[1] == before[1] and after[0] <= before[0]
        gained += before[0] - after[0]
    assert gained > 0


def test_pushes_after_which_all_stands_as_in_the_end_are_left_out():
    levels = stack_levels([Level.from_text("########\n#      #\n# @$.  #\n#      #\n########")])
    (square,) = np.flatnonzero([int(bit_boards(levels).box[0]) >> s & 1 for s in range(64)]).tolist()
    there, back = 4 * square + EAST, 4 * (square + 2) + 3
    way = np.array([there, 4 * (square + 1) + EAST, back], np.uint8)
    assert shorten(*start(levels), way).tolist() == [there]


@pytest.mark.parametrize("pushes", [[], [7]])
def test_there_is_nothing_to_shorten_in_a_single_push(pushes):
    levels = stack_levels([Level.from_text("########\n#@$.####\n########")])
    assert shorten(*start(levels), np.array(pushes, np.uint8)).tolist() == pushes
