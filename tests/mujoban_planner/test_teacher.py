import numpy as np
import pytest
import torch

from mujoban_core.grid import OFFSETS_RC
from mujoban_planner import load
from mujoban_planner.boards import abstract_states, bit_boards, likeliest_boards, state_tensor, take_levels
from mujoban_planner.lessons import LessonMaker, errs
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.planner import input_planes
from mujoban_planner.play import play
from mujoban_planner.propagation import legal_pushes, propagate, walk_to_push
from mujoban_planner.samples import SampleBuffer, make_batch, unlabelled
from mujoban_planner.symmetry import SYMMETRIES, view_states
from mujoban_planner.teacher import DISCOUNT, Teacher, label_deadly
from mujoban_sokoban import rules
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.levels import Level, stack_levels
from mujoban_sokoban.solver import Status, solve_batch


@pytest.fixture(scope="module")
def levels():
    return generate_batch(5, range(24))


@pytest.fixture(scope="module")
def samples(levels):
    return Teacher().demonstrate(levels, np.random.default_rng(0))


def test_boards_round_trip_through_every_form(levels):
    states = abstract_states(levels)
    assert np.array_equal(state_tensor(bit_boards(levels)).numpy(), states)
    for one, other in zip(likeliest_boards(states), bit_boards(levels), strict=True):
        assert np.array_equal(one, other)


def test_following_right_instructions_solves_the_level_with_the_promised_return(levels):
    teacher, rng = Teacher(), np.random.default_rng(1)
    part = take_levels(levels, np.arange(4))
    state, total, factor, over = part, np.zeros(4), 1.0, np.zeros(4, bool)
    promised = None
    for _ in range(150):
        ends = np.zeros(4, bool)
        instruction = np.zeros(4, np.int64)
        for i in np.flatnonzero(~over):
            shown = teacher.demonstrate(take_levels(state, np.array([i])), rng, judged=0.0, keep=1)
            instruction[i] = int(shown.right[0]).bit_length() - 1
            if promised is None or i not in promised:
                promised = {**(promised or {}), i: shown.value[0]}
        result = rules.apply(*state, instruction)
        state = state._replace(boxes=result.boxes, player=result.player)
        total += factor * np.where(over, 0.0, result.reward - 0.01)
        ends = result.solved & ~over
        over |= ends
        factor *= DISCOUNT
        if over.all():
            break
    assert over.all()
    assert promised is not None
    assert total == pytest.approx([promised[i] for i in range(4)], abs=0.05)


def test_labels_turn_with_the_board(samples):
    shown = np.flatnonzero(samples.right)[:64]
    part = samples.take(shown)
    upright = make_batch(part, np.zeros(len(shown), np.int64))
    for symmetry in range(SYMMETRIES):
        batch = make_batch(part, np.full(len(shown), symmetry))
        assert (batch.push_known.flatten(1).gather(1, batch.next_push[:, None])).all()
        assert not (batch.push_dead & ~batch.push_known).any()
        assert torch.equal(batch.state, view_states(upright.state, torch.full((len(upright.state), 1), symmetry)))
        planes = input_planes(batch.state)
        legal = legal_pushes(planes, propagate(planes)[:, 0])
        assert (legal.flatten(1).gather(1, batch.next_push[:, None]) == 1).all()
        # The walk that the value iteration reads off the next push is one of the right instructions.
        wanted = torch.zeros(len(shown), 256).scatter_(1, batch.next_push[:, None], 1.0).view(-1, 4, 8, 8)
        towards, start = walk_to_push(wanted, planes)
        guided = (towards + 2 * start).argmax(1) + 1
        assert batch.right.gather(1, guided[:, None]).all()
        plan = batch.plan.flatten(1).gather(1, (batch.next_push % 64)[:, None])[:, 0]
        assert torch.equal(plan, batch.next_push // 64 + 1)


def as_levels(samples):
    states = state_tensor(samples.boards).numpy()
    players = [tuple(np.argwhere(s[..., 2] > 0)[0].tolist()) for s in states]
    return stack_levels(
        [
            Level(s[..., 0] > 0, s[..., 1] > 0, np.argwhere(s[..., 3] > 0), player)
            for s, player in zip(states, players, strict=True)
        ]
    )


def test_dead_labels_are_what_the_solver_proves(samples):
    dead = np.flatnonzero(samples.dead == 31)[:20]
    assert dead.size
    assert not samples.right[dead].any()
    assert (solve_batch(as_levels(samples.take(dead))).status == Status.UNSOLVABLE).all()
    alive = samples.right != 0
    assert (samples.dead[alive] & samples.right[alive] == 0).all()
    assert (samples.dead & ~samples.dead_known == 0).all()


def test_verdicts_on_pushes_are_what_the_solver_finds(samples):
    shown = samples.take(np.flatnonzero(samples.right)[::40])
    planes = make_batch(shown, np.zeros(len(shown.agent), np.int64))
    legal = legal_pushes(input_planes(planes.state), propagate(input_planes(planes.state))[:, 0]) > 0.5
    missed = (planes.push_known & ~legal).sum() / planes.push_known.sum()
    assert missed < 0.01  # `propagate` does not follow the longest walks to their end
    assert (planes.push_known.sum() / legal.sum()) > 0.95
    levels = as_levels(shown)
    deadly = 0
    for row, direction, r, c in planes.push_known.nonzero().tolist():
        level = take_levels(levels, np.array([row]))
        box = (level.boxes[0] == (r + 1, c + 1)).all(1)
        moved = level.boxes.copy()
        moved[0, box] += OFFSETS_RC[direction + 1]
        lost = solve_batch(level._replace(boxes=moved, player=np.array([[r + 1, c + 1]]))).status[0] != Status.SOLVED
        assert lost == bool(planes.push_dead[row, direction, r, c])
        deadly += lost
    assert deadly > 10


def test_deadly_instruction_labels_nothing_else(levels):
    part = take_levels(levels, np.arange(2))
    samples = label_deadly(part, np.array([1, 3]))
    assert samples.dead.tolist() == [2, 8]
    assert samples.dead_known.tolist() == [3, 9]
    assert np.bitwise_count(samples.push_dead).sum(1).tolist() == [1, 1]
    assert (samples.push_known == samples.push_dead).all()
    assert not samples.right.any()


def test_lessons_are_deterministic_and_streams_differ():
    mix = {1: 0.5, 5: 0.5}
    first, again, other = (LessonMaker(stream, mix).demonstrations(12) for stream in (0, 0, 1))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert len(other.agent) != len(first.agent) or not np.array_equal(first.wall, other.wall)
    with pytest.raises(ValueError, match="stream -1"):
        LessonMaker(-1, mix)


def test_lessons_can_be_of_long_levels():
    maker = LessonMaker(6, {4: 0.5, 5: 0.5}, long=1.0, long_moves=40)
    levels = maker.levels(12)
    assert (Teacher().moves(levels[5]) >= 40).all()
    assert (Teacher().moves(levels[4]) < 40).any()
    usual = LessonMaker(6, {5: 1.0}, long=0.5, long_moves=40).levels(40)[5]
    assert len(usual.player) == 40 and 10 < (Teacher().moves(usual) >= 40).sum() < 36


def test_corrections_show_the_way_from_where_an_untrained_planner_went_wrong():
    samples = LessonMaker(3, {5: 1.0}).corrections(ResidualPlanner(8, 1).eval(), n=6)
    deadly = (samples.dead != 0) & (samples.dead != 31)
    assert (samples.right != 0).any() and deadly.any()


def test_lost_levels_are_played_again(monkeypatch):
    played = []

    def record(planner, levels, **options):
        played.append({wall.tobytes() for wall in levels.wall})
        return play(planner, levels, **options)

    monkeypatch.setattr("mujoban_planner.lessons.play", record)
    maker, beginner = LessonMaker(5, {5: 1.0}), ResidualPlanner(8, 1).eval()
    for _ in range(2):
        maker.corrections(beginner, n=6)
    first, second = played
    assert len(first) == 6
    again = second & first
    assert 1 <= len(again) <= 3 and len(second) == 6 + len(again)


def test_planner_errs_where_the_truth_is_another_than_it_says():
    samples = LessonMaker(4, {1: 1.0}).demonstrations(80)
    planner = load()
    unjudged = samples._replace(
        dead_known=np.zeros_like(samples.dead_known), push_known=np.zeros_like(samples.push_known)
    )
    assert errs(planner, unjudged).mean() < 0.2
    samples = samples.take(np.flatnonzero(~errs(planner, samples)))
    assert len(samples.agent) > 20
    false_verdicts = samples._replace(dead=samples.dead_known & ~samples.dead)
    assert errs(planner, false_verdicts).mean() > 0.9
    samples = samples.take(np.flatnonzero(samples.push_known.any(1)))
    false_pushes = samples._replace(push_dead=samples.push_known & ~samples.push_dead)
    assert errs(planner, false_pushes).mean() > 0.9
    assert errs(planner, samples.take(np.zeros(0, np.int64))).shape == (0,)


def test_buffer_keeps_the_newest_samples(samples):
    buffer = SampleBuffer(100)
    marked = unlabelled(samples.take(np.arange(250)).boards)
    for first in range(0, 250, 50):
        part = marked.take(np.arange(first, first + 50))
        buffer.add(part._replace(value=np.arange(first, first + 50, dtype=np.float32)))
    drawn = buffer.draw(500, np.random.default_rng(0))
    assert drawn.value.min() >= 150
    with pytest.raises(ValueError, match="buffer of 100"):
        buffer.add(marked)
