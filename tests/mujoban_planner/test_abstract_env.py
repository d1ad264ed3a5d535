import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_planner.abstract_env import STEP_REWARD, AbstractEnvironment
from mujoban_planner.boards import abstract_states, likeliest_boards
from mujoban_sokoban import bitboard, rules
from mujoban_sokoban.generator import generate_batch, generate_level


def _environment(boards, **options):
    env = AbstractEnvironment(len(boards.player), **options)
    env.reset_to(torch.arange(env.batch), torch.from_numpy(abstract_states(boards)))
    return env


def _boards(difficulty, seed, n):
    return generate_batch(difficulty, range(seed, seed + n))


@settings(max_examples=15)
@given(difficulty=st.integers(1, 5), seed=st.integers(0, 10_000), actions=st.integers(0, 2**32 - 1))
def test_moves_and_pushes_are_those_of_the_bitboard(difficulty, seed, actions):
    env, rng = _environment(_boards(difficulty, seed, 16)), np.random.default_rng(actions)
    for _ in range(60):
        before, over, instruction = likeliest_boards(env.observe().numpy()), env.solved.numpy(), rng.integers(0, 5, 16)
        env.step(torch.from_numpy(instruction))
        after = likeliest_boards(env.observe().numpy())
        for i in np.flatnonzero(~over & (instruction > 0)):
            agent, box, direction = int(before.agent[i]), before.box[i], int(instruction[i]) - 1
            there = bitboard.stepped(np.uint64(bitboard.bit(agent)), ~(before.wall[i] | box), box, direction)
            to = int(after.agent[i])
            assert there == (bitboard.NONE if to == agent else bitboard.bit(to))
            assert after.box[i] == (bitboard.pushed(box, to, direction) if there & box else box)


@settings(max_examples=15)
@given(difficulty=st.integers(1, 5), seed=st.integers(0, 10_000), actions=st.integers(0, 2**32 - 1))
def test_rules_and_rewards_are_those_of_the_simulator(difficulty, seed, actions):
    boards = _boards(difficulty, seed, 16)
    env, rng = _environment(boards), np.random.default_rng(actions)
    over = np.zeros(16, bool)
    for _ in range(60):
        instruction = rng.integers(0, 5, 16)
        outcome = env.step(torch.from_numpy(instruction))
        expected = rules.apply(*boards, np.where(over, 0, instruction))
        boards = boards._replace(boxes=expected.boxes, player=expected.player)
        assert np.array_equal(env.observe().numpy(), abstract_states(boards))
        assert np.array_equal(outcome.solved.numpy(), expected.solved)
        reward = np.where(over, 0.0, expected.reward + np.float32(STEP_REWARD))
        assert np.allclose(outcome.reward.numpy(), reward)
        over |= expected.solved


def test_solving_pays_once_and_ends_the_episode():
    level = "#####\n#@$.#\n#####"
    from mujoban_sokoban.levels import Level

    env = AbstractEnvironment(1)
    env.reset(torch.tensor([0]), [Level.from_text(level)])
    first = env.step(torch.tensor([2]))
    assert first.solved.all() and not first.truncated.any()
    assert first.reward.item() == pytest.approx(1 + 10 - 0.01)
    assert env.step(torch.tensor([4])).reward.item() == 0.0


def test_move_limit_truncates():
    env = _environment(_boards(5, 0, 4), move_limit=3)
    truncated = [env.step(torch.zeros(4, dtype=torch.int64)).truncated.all().item() for _ in range(3)]
    assert truncated == [False, False, True]


def test_failed_instructions_change_nothing_and_end_the_abstract_episode():
    env = _environment(_boards(5, 0, 512), failure_rate=0.25, generator=torch.Generator().manual_seed(0))
    before = env.observe()
    outcome = env.step(torch.randint(1, 5, (512,), generator=torch.Generator().manual_seed(1)))
    assert torch.equal(env.observe()[outcome.failed], before[outcome.failed])
    assert outcome.truncated[outcome.failed].all()
    assert 0.15 < outcome.failed.float().mean().item() < 0.35


def test_bad_input_is_named():
    env = AbstractEnvironment(2)
    with pytest.raises(ValueError, match="expected"):
        env.step(torch.tensor([0, 5]))
    with pytest.raises(ValueError, match="1 rows for 2 levels"):
        env.reset(torch.tensor([0]), [generate_level(1, 0), generate_level(1, 1)])
    with pytest.raises(ValueError, match="failure_rate"):
        AbstractEnvironment(2, failure_rate=0.5)
