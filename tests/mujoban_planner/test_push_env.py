import numpy as np
import pytest

from mujoban_planner.boards import abstract_states, bit_boards, level_batch, state_tensor, take_levels
from mujoban_planner.push_env import PushEnvironment
from mujoban_planner.teacher import STEP_REWARD
from mujoban_sokoban import rules
from mujoban_sokoban.bitboard import SQUARE_STEP
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.levels import Level, stack_levels
from mujoban_sokoban.solver import Status, solve_batch
from mujoban_sokoban.solver_labels import moves_of

LEVELS = generate_batch(4, range(40))


def random_pushes(mask, rng):
    return np.array([rng.choice(np.flatnonzero(row)) if row.any() else 0 for row in mask])


def test_boards_and_levels_are_the_same_states():
    again = level_batch(bit_boards(LEVELS))
    assert (abstract_states(again) == abstract_states(LEVELS)).all()
    assert (abstract_states(LEVELS) == state_tensor(bit_boards(LEVELS)).numpy()).all()


def test_a_push_is_its_moves_under_the_rules_with_their_rewards():
    rng = np.random.default_rng(0)
    env = PushEnvironment(40)
    env.reset_to(np.arange(40), bit_boards(LEVELS))
    levels, total = take_levels(LEVELS, np.arange(40)), np.zeros(40, np.int64)
    playing, compared = np.arange(40), 0
    for _ in range(12):
        before = env.boards._replace(box=env.boards.box.copy(), agent=env.boards.agent.copy())
        push = random_pushes(env.possible(), rng)
        step = env.step(push)
        for i in playing:
            moves = np.zeros(64, np.int64)
            one = np.array([4 * (push[i] % 64) + push[i] // 64], np.uint8)
            moves_of(~before.wall[i], before.box[i], int(before.agent[i]), one, rng, moves)
            assert step.moves[i] == np.count_nonzero(moves)
            reward, level = 0.0, take_levels(levels, np.array([i]))
            for move in moves[: step.moves[i]]:
                result = rules.apply(*level, np.array([move]))
                assert result.moved[0]
                level = level._replace(boxes=result.boxes, player=result.player)
                reward += result.reward[0] + STEP_REWARD
            assert step.reward[i] == pytest.approx(reward, abs=1e-5)
            assert step.solved[i] == result.solved[0]
            levels.boxes[i], levels.player[i] = level.boxes[0], level.player[0]
        total[playing] += step.moves[playing]
        compared += len(playing)
        assert (env.moves[playing] == total[playing]).all()
        states = state_tensor(env.boards).numpy()
        assert (states[playing] == abstract_states(take_levels(levels, playing))).all()
        playing = playing[~step.over[playing]]
        over = np.setdiff1d(np.arange(40), playing)
        env.reset_to(over, bit_boards(take_levels(LEVELS, over)))
    assert compared > 100 and len(playing) < 40


def test_all_pushes_that_the_rules_allow_after_a_walk_are_possible_and_no_others():
    env = PushEnvironment(40)
    env.reset_to(np.arange(40), bit_boards(LEVELS))
    mask = env.possible()
    for i in range(40):
        level = take_levels(LEVELS, np.array([i]))
        seen, queue, pushes = {tuple(level.player[0])}, [level], set()
        while queue:
            at = queue.pop()
            for instruction in range(1, 5):
                result = rules.apply(*at, np.array([instruction]))
                if (result.boxes != at.boxes).any():
                    box = at.player[0] + result.player[0] - at.player[0]
                    pushes.add(64 * (instruction - 1) + 8 * (box[0] - 1) + box[1] - 1)
                elif tuple(result.player[0]) not in seen:
                    seen.add(tuple(result.player[0]))
                    queue.append(at._replace(player=result.player))
        assert set(np.flatnonzero(mask[i]).tolist()) == pushes


def test_episodes_end_when_solved_at_the_limit_and_where_no_solution_is_left_at_sight():
    rng = np.random.default_rng(1)
    env = PushEnvironment(40, move_limit=25)
    env.reset_to(np.arange(40), bit_boards(LEVELS))
    ended = set()
    for _ in range(25):
        step = env.step(random_pushes(env.possible(), rng))
        assert (env.moves <= 25).all()
        hopeless = step.terminated & ~step.solved
        assert (step.truncated <= (env.moves == 25)).all() and not (step.terminated & step.truncated).any()
        if hopeless.any():
            lost = level_batch(type(env.boards)._make(column[hopeless] for column in env.boards))
            assert (solve_batch(lost).status == Status.UNSOLVABLE).all()
            ended.add("hopeless")
        ended |= {"limit"} if step.truncated.any() else set()
        over = np.flatnonzero(step.over)
        env.reset_to(over, bit_boards(take_levels(LEVELS, over)))
    assert ended == {"hopeless", "limit"}


def test_a_push_that_is_not_possible_is_refused():
    env = PushEnvironment(1)
    env.reset_to(np.arange(1), bit_boards(stack_levels([Level.from_text("######\n#@$ .#\n######")])))
    square = 8 * int(env.boards.agent[0] // 8) + int(env.boards.agent[0] % 8) + int(SQUARE_STEP[1])
    for push in (64 * 3 + square, 64 * 1 + square + 1, 999, -1):
        with pytest.raises(ValueError, match="expected one of"):
            env.step(np.array([push]))
    with pytest.raises(ValueError, match="expected \\(1,\\)"):
        env.step(np.zeros(2, np.int64))
    assert env.step(np.array([64 + square])).moves[0] == 1
