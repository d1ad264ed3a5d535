import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mujoban_core.grid import Instruction, cell_to_xy
from mujoban_sim.goals import GoalKind, GoalTracker, is_completed
from mujoban_sokoban.rules import apply

N, E, S, W, STAY = Instruction.NORTH, Instruction.EAST, Instruction.SOUTH, Instruction.WEST, Instruction.STAY


def wall_around(*walls):
    wall = np.zeros((1, 10, 10), bool)
    wall[:, [0, -1]] = True
    wall[:, :, [0, -1]] = True
    for cell in walls:
        wall[0][cell] = True
    return wall


def begin(tracker, direction, agent, boxes=((-1, -1),), walls=()):
    tracker.begin(np.array([0]), np.array([direction]), wall_around(*walls), np.array([agent]), np.array([boxes]))
    return tracker


def completed(tracker, robot, box=(50.0, 50.0), speed=0.0):
    """Check as the world does after a step."""
    tracker.reached[0] = is_completed(
        int(tracker.kind[0]), tracker.robot_target[0], tracker.box_target[0], tuple(robot), tuple(box), speed,
        tracker.tolerance, tracker.max_box_speed,
    )  # fmt: skip
    return bool(tracker.reached[0])


def off(cell, dx=0.0, dy=0.0):
    return cell_to_xy(cell) + np.array([dx, dy])


def test_nothing_is_completed_before_the_first_instruction():
    assert not completed(GoalTracker(1), (0.0, 0.0))


@pytest.mark.parametrize(("direction", "to"), [(N, (3, 4)), (E, (4, 5)), (S, (5, 4)), (W, (4, 3))])
def test_a_move_is_completed_within_a_tenth_of_the_next_cells_centre(direction, to):
    tracker = begin(GoalTracker(1), direction, (4, 4))
    assert tracker.kind[0] == GoalKind.MOVE
    assert not completed(tracker, off((4, 4)))
    assert not completed(tracker, off(to, 0.08, 0.08))
    assert completed(tracker, off(to, 0.06, -0.07))


def test_a_push_is_completed_when_the_box_is_there_wherever_the_robot_is():
    tracker = begin(GoalTracker(1), E, (4, 4), [(4, 5)])
    assert tracker.kind[0] == GoalKind.PUSH
    assert not completed(tracker, off((4, 5)), off((4, 5)))
    assert completed(tracker, off((4, 5), 0.4), off((4, 6), -0.09))
    assert not completed(tracker, off((4, 5), 0.4), off((4, 6), 0.11))


def test_a_pushed_box_must_be_slow():
    tracker = begin(GoalTracker(1), E, (4, 4), [(4, 5)])
    assert not completed(tracker, off((4, 5)), off((4, 6)), speed=0.31)
    assert completed(tracker, off((4, 5)), off((4, 6)), speed=0.29)
    assert completed(begin(GoalTracker(1, max_box_speed=np.inf), E, (4, 4), [(4, 5)]), (9.0, 9.0), off((4, 6)), 5.0)


def test_the_box_in_the_way_is_the_one_that_counts():
    tracker = GoalTracker(1)
    begin(tracker, N, (4, 4), [(7, 7), (3, 4), (2, 2)])
    assert tracker.box_index[0] == 1
    assert np.allclose(tracker.box_target[0], cell_to_xy((2, 4)))


@pytest.mark.parametrize(
    ("direction", "boxes", "walls"),
    [
        (STAY, [(-1, -1), (-1, -1)], []),
        (E, [(-1, -1), (-1, -1)], [(4, 5)]),
        (E, [(4, 5), (-1, -1)], [(4, 6)]),
        (E, [(4, 5), (4, 6)], []),
    ],
    ids=["stay", "wall", "box before wall", "box before box"],
)
def test_what_cannot_be_done_asks_the_robot_to_remain_in_its_cell(direction, boxes, walls):
    tracker = begin(GoalTracker(1), direction, (4, 4), boxes, walls)
    assert tracker.kind[0] == GoalKind.HOLD
    assert completed(tracker, off((4, 4), 0.09))
    assert not completed(tracker, off((4, 4), 0.2))
    assert not completed(tracker, off((4, 5)))


def test_after_a_completed_push_the_next_instruction_counts_from_where_the_push_led():
    tracker = begin(GoalTracker(1), E, (4, 4), [(4, 5)])
    assert completed(tracker, off((4, 5), 0.49), off((4, 6), 0.09))
    # The robot's position already rounds into the cell before or behind; the instruction led to (4, 5).
    begin(tracker, N, (4, 4), [(4, 6)])
    assert tracker.origin_cell[0].tolist() == [4, 5]
    assert np.allclose(tracker.robot_target[0], cell_to_xy((3, 5)))


def test_after_a_failed_instruction_the_next_counts_from_where_the_robot_is():
    tracker = begin(GoalTracker(1), E, (4, 4))
    assert not completed(tracker, off((4, 4)))
    begin(tracker, N, (4, 4))
    assert tracker.origin_cell[0].tolist() == [4, 4]


def test_reset_forgets_where_the_last_instruction_led():
    tracker = begin(GoalTracker(1), E, (4, 4))
    assert completed(tracker, off((4, 5)))
    tracker.reset(np.array([0]))
    assert tracker.kind[0] == GoalKind.NONE
    begin(tracker, N, (2, 2))
    assert tracker.origin_cell[0].tolist() == [2, 2]


def test_tolerance_and_speed_scale_with_the_cell():
    tracker = begin(GoalTracker(1, cell_size=3.0), E, (4, 4), [(4, 5)])
    assert completed(tracker, (0.0, 0.0), 3 * off((4, 6), 0.09), speed=0.8)
    assert not completed(tracker, (0.0, 0.0), 3 * off((4, 6), 0.11), speed=0.8)


@given(st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_goals_agree_with_the_rules_of_sokoban(direction, seed):
    rng = np.random.default_rng(seed)
    wall = wall_around()[0] | (rng.random((10, 10)) < 0.3)
    cells = rng.permutation(np.argwhere(~wall))[:4]
    agent, boxes = cells[0], cells[1:]
    tracker = GoalTracker(1)
    tracker.begin(np.array([0]), np.array([direction]), wall[None], agent[None], boxes[None])
    result = apply(wall, wall, boxes, agent, direction)
    assert (tracker.kind[0] == GoalKind.HOLD) == (not result.moved)
    assert tracker.goal_cell[0].tolist() == result.player.tolist()
    assert (tracker.kind[0] == GoalKind.PUSH) == (not np.array_equal(result.boxes, boxes))


def test_memory_restores_a_tracker():
    tracker = begin(GoalTracker(1), E, (4, 4), [(4, 5)])
    other = GoalTracker(1)
    other.restore(tracker.memory())
    tracker.reset(np.array([0]))
    assert other.kind[0] == GoalKind.PUSH
    assert completed(other, off((4, 5)), off((4, 6)))


def test_unknown_instructions_and_tolerances_are_rejected():
    with pytest.raises(ValueError, match="instruction"):
        begin(GoalTracker(1), 5, (4, 4))
    with pytest.raises(ValueError, match="tolerance"):
        GoalTracker(1, tolerance=0.0)
