"""Batched rollouts: every episode once, the same whatever the batch, and failures put down to the right module."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from bringup.evaluate import evaluate
from bringup.failure import DecisionRecord, explain, is_unsolvable, playable_region
from bringup.results import EpisodeResult, Failure, report
from bringup.rollout import ticks
from mujoban_core.grid import AGENT, BOX, TARGET, WALL, Instruction
from mujoban_core.interfaces import Planner
from mujoban_sim.oracles import OracleController, OracleEstimator
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.levels import Level, write_levels
from mujoban_sokoban.rules import abstract_successor

CORNER = """\
######
#    #
# $@ #
#  . #
######
"""


@dataclass(frozen=True)
class Scripted(Planner):
    """Says the given moves, then stay."""

    moves: tuple[Instruction, ...]

    def initial_memory(self, batch):
        return (np.zeros(batch, np.int64),)

    def decide(self, abstract_state, memory):
        (said,) = memory
        moves = [self.moves[n] if n < len(self.moves) else Instruction.STAY for n in said]
        return np.array(moves, np.int64), (said + 1,)


class Blind(OracleEstimator):
    """Sees no boxes."""

    def step(self, inputs, state):
        estimate, state = super().step(inputs, state)
        blind = estimate.copy()
        blind[..., BOX] = 0.0
        return blind, state


class Idle(OracleController):
    """Does nothing."""

    def step(self, inputs, state):
        torque, state = super().step(inputs, state)
        return np.zeros_like(torque), state


@pytest.fixture(scope="module")
def policy(oracles):
    return oracles.policy()


@pytest.fixture
def corner(tmp_path):
    path = tmp_path / "corner.txt"
    write_levels(path, [Level.from_text(CORNER)])
    return Episodes(1, 0, level_file=path)


def test_oracles_solve_and_outcomes_do_not_depend_on_the_batch(policy):
    episodes = Episodes(5, 20, difficulty=2)
    outcomes = [evaluate(policy, episodes, batch=batch) for batch in (1, 3)]
    assert outcomes[0] == outcomes[1]
    assert [r.seed for r in outcomes[0]] == [20, 21, 22, 23, 24]
    assert all(r.solved and r.episode_return >= 11 and r.failure is None for r in outcomes[0])


def test_a_world_with_more_rows_than_episodes_plays_each_once(policy):
    episodes = Episodes(2, 0, difficulty=1)
    world = World(3, max_boxes=episodes.max_boxes)
    played = list(ticks(policy, world, episodes))
    assert {int(e) for t in played for e in t.episode} == {0, 1}
    assert sum(int(t.solved.sum()) for t in played) == 2


def test_a_planner_that_pushes_into_a_corner_is_a_dead_end(policy, corner):
    moves = (Instruction.WEST, Instruction.STAY)
    (result,) = evaluate(replace(policy, planner=Scripted(moves)), corner, time_limit=400)
    assert (result.failure, result.wrong_estimates) == (Failure.PLANNER_DEAD_END, 0)


def test_a_planner_that_goes_in_circles_is_a_dead_end(policy, corner):
    moves = (Instruction.NORTH, Instruction.SOUTH) * 20
    (result,) = evaluate(replace(policy, planner=Scripted(moves)), corner, time_limit=900)
    assert result.failure == Failure.PLANNER_DEAD_END


def test_the_same_push_on_a_wrong_estimate_is_put_down_to_the_estimate(policy, corner):
    blind = replace(policy, planner=Scripted((Instruction.WEST,)), estimator=Blind())
    (result,) = evaluate(blind, corner, time_limit=400)
    assert result.failure == Failure.WRONG_ESTIMATE and result.wrong_estimates == result.instructions


def test_a_controller_that_does_nothing_times_out(policy, corner):
    (result,) = evaluate(replace(policy, controller=Idle()), corner, time_limit=600)
    assert result.failure == Failure.CONTROLLER_TIME_OUT and result.time_outs >= 3


@pytest.mark.parametrize(
    ("move", "why"),
    [(Instruction.EAST, (Failure.CONTROLLER_TIME_OUT, 4)), (Instruction.WEST, (Failure.WRONG_ESTIMATE, 0))],
    ids=["possible", "blocked"],
)
def test_only_what_was_not_possible_is_put_down_to_a_wrong_estimate(policy, tmp_path, move, why):
    write_levels(tmp_path / "blocked.txt", [Level.from_text(CORNER.replace("# $@ #\n#  . #", "#$@  #\n#.   #"))])
    stuck = replace(policy, estimator=Blind(), planner=Scripted((move,) * 9), controller=Idle())
    (result,) = evaluate(stuck, Episodes(1, 0, level_file=tmp_path / "blocked.txt"), time_limit=600)
    assert (result.failure, result.time_outs) == why


def test_an_episode_that_is_merely_too_short_ran_into_the_time_limit(policy):
    (result,) = evaluate(policy, Episodes(1, 0, difficulty=5), time_limit=60)
    assert result.failure == Failure.TIME_LIMIT and result.steps == 60


def test_states_outside_the_rules_are_not_called_unsolvable():
    state = Level.from_text(CORNER).abstract_state() > 0.5
    assert not is_unsolvable(state)
    two_in_one = state.copy()
    two_in_one[..., BOX] = False
    assert not is_unsolvable(two_in_one)
    state[..., BOX] = False
    state[tuple(np.argwhere(playable_region(state))[0])][BOX] = True
    assert is_unsolvable(state)


def test_the_playable_region_is_what_the_walls_enclose():
    state = Level.from_text(CORNER).abstract_state() > 0.5
    region = playable_region(state)
    assert region.sum() == 12 and not (region & state[..., WALL]).any()
    assert region[state[..., TARGET] | state[..., AGENT] | state[..., BOX]].all()


def test_a_report_gives_rate_interval_return_and_every_episode():
    episode = EpisodeResult(3, True, 11.0, 50, 4, 0, 0, None)
    content = report([episode, replace(episode, solved=False, failure=Failure.TIME_LIMIT)], {"planner": "oracle"})
    assert content["success_rate"] == 0.5 and content["mean_return"] == 11.0
    low, high = content["success_interval"]
    assert 0.0 < low < 0.5 < high < 1.0
    assert [e["failure"] for e in content["episodes"]] == [None, "time limit"]
    assert content["weights"] == {"planner": "oracle"}
    with pytest.raises(ValueError, match="at least one"):
        report([], {})


@pytest.mark.parametrize("bad", [{"difficulty": 6}, {"seed": -1}, {"count": 0}])
def test_bad_runs_of_episodes_are_refused(bad):
    options = {"count": 1, "seed": 0} | bad
    with pytest.raises(ValueError, match=str(next(iter(bad.values())))):
        Episodes(options.pop("count"), options.pop("seed"), **options)


def test_a_level_that_the_last_instruction_loses_is_lost_by_it():
    before = Level.from_text("######\n#   .#\n# $@ #\n#    #\n######").abstract_state() > 0.5
    decision = DecisionRecord(before, int(Instruction.WEST), estimate_right=True, timed_out=False)
    after = abstract_successor(before, Instruction.WEST)
    assert is_unsolvable(after) and not is_unsolvable(before)
    assert explain([decision], after) == Failure.PLANNER_DEAD_END
    assert explain([decision], before) == Failure.TIME_LIMIT


def test_a_box_in_the_cell_that_the_robot_has_half_left_proves_nothing():
    """It keeps its cell while it rounds into a box's; another box may be pushed into that meanwhile."""
    state = Level.from_text("######\n#$   #\n# @ .#\n#    #\n######").abstract_state() > 0.5
    assert is_unsolvable(state)
    row, column = np.argwhere(state[..., BOX])[0]
    state[..., AGENT] = False
    state[row, column, AGENT] = True
    assert not is_unsolvable(state) and explain([], state) == Failure.TIME_LIMIT
