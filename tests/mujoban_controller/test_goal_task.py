"""The goal task: instructions, rewards, episodes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mujoban_controller.drivers import ControllerDriver
from mujoban_controller.episodes import SeededEpisodes
from mujoban_controller.goal_features import feature_layout
from mujoban_controller.goal_rewards import GoalReward, RewardConfig, potential
from mujoban_controller.goal_settings import GoalTaskConfig, judging_config
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.instructions import EXACT, InstructionConfig
from mujoban_controller.judge import failure_name, judge
from mujoban_controller.scripted import scripted_driver
from mujoban_controller.turning import judge_turning
from mujoban_core.bodies import BALL
from mujoban_core.grid import CONTROL_PERIOD, OFFSETS_XY, Instruction, cell_to_xy
from mujoban_core.interfaces import Planner
from mujoban_sim.goals import GoalKind
from mujoban_sim.oracles import OracleController, OraclePlanner


class Stubborn(Planner):
    """Always gives the same instruction."""

    def __init__(self, instruction):
        self.instruction = instruction

    def initial_memory(self, batch):
        return ()

    def decide(self, abstract_state, memory):
        return np.full(len(abstract_state), self.instruction), memory


def make(config=None, planner=None, seed=0, **changes):
    config = dataclasses.replace(config or GoalTaskConfig(batch=4, difficulty=1), **changes)
    episodes = SeededEpisodes(config.difficulty, 10_000_000 + seed)
    return GoalTask(config, planner or OraclePlanner(), episodes, np.random.default_rng(seed))


def play(task, steps, driver=scripted_driver):
    return [task.step(driver(task)) for _ in range(steps)]


def idle(task):
    return np.zeros((task.world.batch, 2), np.float32)


def test_a_good_driver_is_rewarded_for_each_instruction():
    good, idle_task = make(misaligned=0.0, horizon=np.inf), make(misaligned=0.0, horizon=np.inf)
    results = play(good, 200)
    outcomes = [o for r in results for o in r.outcomes]
    assert len(outcomes) > 10 and all(o.completed for o in outcomes)
    bonus = good.config.reward.completed * len(outcomes)
    total = float(sum(r.reward.sum() for r in results))
    assert total > bonus > 0.0 > sum(float(r.reward.sum()) for r in play(idle_task, 200, idle))


def test_an_idle_robot_fails_moves_after_the_limit_and_is_given_up_after_some():
    task = make(planned=1.0, astray=0.0, misaligned=0.0, patience=2, horizon=np.inf)
    results = play(task, 240, idle)
    failures = [(t + 1, r) for t, r in enumerate(results) if r.outcomes]
    assert [t for t, _ in failures] == [120, 240]
    assert failures[0][1].reward == pytest.approx(np.full(4, task.config.reward.failed), abs=0.3)
    assert failures[0][1].discount.tolist() == [0.0] * 4
    assert [o.completed for o in failures[0][1].outcomes] == [False] * 4
    assert len(failures[1][1].episodes) == 4
    assert task.first.all()
    assert not task.terminated.any()


def test_a_fall_ends_the_episode_and_is_named_as_the_cause(monkeypatch):
    task = make(planned=1.0, astray=0.0, misaligned=0.0, horizon=np.inf)
    play(task, 5, idle)
    monkeypatch.setattr("mujoban_controller.goal_task.fallen", lambda world: np.arange(world.batch) == 1)
    (result,) = play(task, 1, idle)
    assert [(o.row, o.completed, failure_name(o)) for o in result.outcomes] == [(1, False, "fallen")]
    assert [e.row for e in result.episodes] == [1] and result.discount.tolist() == [1.0, 0.0, 1.0, 1.0]


def test_the_signal_comes_with_the_next_instruction_and_says_what_the_rule_said():
    task = make(misaligned=0.0, planned=1.0, astray=0.0, terminations=EXACT)
    for _ in range(120):
        result = task.step(scripted_driver(task))
        inputs = task.observe(camera=False)
        ended = {o.row for o in result.outcomes} - {e.row for e in result.episodes}
        assert ended == set(np.flatnonzero(inputs.terminated))
        assert set(np.flatnonzero(inputs.truth.completed)) >= {
            o.row for o in result.outcomes if o.completed and o.row in ended
        }


def test_planned_rows_follow_the_planner_and_random_ones_do_not():
    planned = make(planned=1.0, astray=0.0, planner=Stubborn(Instruction.WEST))
    assert set(planned.instruction) == {Instruction.WEST}
    random = make(planned=0.0, planner=Stubborn(Instruction.WEST), batch=32)
    assert len(set(random.instruction.tolist())) > 2


def test_misaligned_starts_leave_nothing_in_collision():
    task = make(batch=32, difficulty=5, misaligned=1.0)
    start = task.world.box_position.copy()
    assert np.abs(task.world.pose[:, :2] % 1.0 - 0.5).max() > 0.1
    for _ in range(10):
        task.world.step(np.zeros((32, 2), np.float32))
    assert np.abs(task.world.box_position - start).max() < 0.02


def test_some_misaligned_starts_are_amid_a_push_and_off_the_lane():
    world = make(batch=128, difficulty=5, misaligned=1.0).world
    off = world.pose[:, :2] - cell_to_xy(world.agent_cell)
    apart = world.box_position - world.pose[:, None, :2]
    axis = np.eye(2)[np.abs(off).argmax(1)] * np.sign(off)
    along = (apart * axis[:, None]).sum(-1)
    across = np.abs(apart - along[..., None] * axis[:, None]).max(-1)
    ahead = (np.arange(world.max_boxes) < world.box_count[:, None]) & (along > 0) & (along < 0.75) & (across < 0.4)
    amid = ahead.any(1) & (np.abs(off).max(1) > 0.35)
    assert amid.sum() > 3 and (np.abs(off[amid]).min(1) > 0.1).any()
    assert along[ahead].min() > 0.59, "no robot begins within a box"


def test_the_same_seed_gives_the_same_task():
    first, second = make(seed=3), make(seed=3)
    a, b = play(first, 60), play(second, 60)
    assert all(np.array_equal(x.reward, y.reward) for x, y in zip(a, b, strict=True))
    assert np.array_equal(first.world.pose, second.world.pose)


def seen_from(direction, heading, offset):
    """Return the features of a robot `offset` (along, left) in cells off its cell, with a heading off its lane."""
    task = make(planned=1.0, astray=0.0, misaligned=0.0, planner=Stubborn(direction), batch=8)
    world = task.world
    row = np.flatnonzero(world.goals.kind == GoalKind.MOVE)[0]
    along = OFFSETS_XY[direction]
    pose = world.pose.astype(float)
    pose[:, :2] += offset[0] * along + offset[1] * np.array([-along[1], along[0]])
    pose[:, 2] = np.arctan2(along[1], along[0]) + heading
    world.place(np.arange(8), pose, world.box_position)
    task.torque[:] = (0.3, np.sign(heading) * 0.7)
    features = task.features()[row]
    assert features.shape == (feature_layout(BALL).size,)
    return features[: -len(SURROUNDINGS)]


SURROUNDINGS = range(22)


def test_features_do_not_depend_on_the_direction_of_the_instruction():
    # The same situation, turned by 90 degrees, looks the same to critic and teacher.
    views = [seen_from(d, 0.3, (-0.05, 0.1)) for d in (Instruction.EAST, Instruction.NORTH, Instruction.WEST)]
    assert views[0] == pytest.approx(views[1], abs=1e-5)
    assert views[0] == pytest.approx(views[2], abs=1e-5)


def test_the_mirrored_situation_has_the_mirrored_features():
    one = seen_from(Instruction.EAST, 0.3, (-0.05, 0.1))
    other = seen_from(Instruction.EAST, -0.3, (-0.05, -0.1))
    mirror = feature_layout(BALL).mirror
    size = len(one)
    assert one != pytest.approx(other, abs=0.05)
    assert one == pytest.approx(other[mirror.source[:size]] * mirror.sign[:size], abs=1e-5)
    full = np.arange(feature_layout(BALL).size)
    assert np.array_equal(mirror.source[mirror.source], full)


def test_the_scripted_driver_solves_whole_levels():
    report = judge(scripted_driver, OraclePlanner(), episodes=4, first_seed=7, difficulty=2)
    assert report["success_rate"] == 1.0
    assert report["lost"] == {}
    assert report["instructions"]["kinds"]["move"]["success_rate"] == 1.0


def test_random_instructions_judge_every_kind():
    report = judge(scripted_driver, OraclePlanner(), episodes=3, first_seed=7, difficulty=5, plans=False)
    kinds = report["instructions"]["kinds"]
    assert set(kinds) == {"move", "push", "stay", "blocked"}
    assert all(kind["success_rate"] > 0.9 for kind in kinds.values())
    assert report["instructions"]["feasible"]["n"] == sum(k["n"] for name, k in kinds.items() if name != "blocked")


def test_controllers_and_drivers_are_judged_alike():
    report = judge(ControllerDriver(OracleController()), OraclePlanner(), episodes=2, first_seed=7, difficulty=1)
    assert report["success_rate"] == 1.0


def test_it_is_judged_how_far_a_robot_turns_while_it_is_told_to_stay():
    def spin(task):
        return np.tile(np.float32(BALL.turn), (len(task.torque), 1))

    drivers = (spin, scripted_driver)
    turning, standing = (judge_turning(driver, episodes=4, first_seed=7)["turned"] for driver in drivers)
    assert turning["20"]["slowest"] > 45.0 and turning["40"]["median"] > turning["20"]["median"]
    assert standing["120"]["median"] < 10.0 and standing["120"]["off_middle"] < 0.1


def test_what_failed_is_tried_again_from_where_it_began():
    # Seeds 10,000,000 to 10,000,003 begin first; an idle robot fails in each of them.
    task = make(planned=1.0, astray=0.0, misaligned=0.0, patience=1, horizon=np.inf, retry=1.0)
    started = [(spec.seed, spec.level.player, spec.level.boxes.tolist()) for spec in task.world.episodes]
    play(task, 121, idle)
    again = [(spec.seed, spec.level.player, spec.level.boxes.tolist()) for spec in task.world.episodes]
    assert set(map(str, again)) <= set(map(str, started))
    fresh = make(planned=1.0, astray=0.0, misaligned=0.0, patience=1, horizon=np.inf)
    play(fresh, 121, idle)
    assert {spec.seed for spec in fresh.world.episodes}.isdisjoint(seed for seed, *_ in started)


def test_settings_that_contradict_the_evaluation_are_refused():
    with pytest.raises(ValueError, match=r"tolerance is 0\.2"):
        GoalTaskConfig(tolerance=0.2)
    with pytest.raises(ValueError, match=r"retry is 2\.0: expected a share"):
        GoalTaskConfig(retry=2.0)
    with pytest.raises(ValueError, match="difficulty is 9"):
        judging_config(4, difficulty=9)


def turning_is_worth(body, off=0.0):
    """Return what turning to the left at 1 rad/s adds to a tick's reward, so many cells off the middle."""
    settings = InstructionConfig(stay=1.0)
    task = make(body=body, planned=0.0, misaligned=0.0, instructions=settings, terminations=EXACT)
    world, ends, reward = task.world, np.zeros((2, 4), np.bool_), GoalReward(RewardConfig())
    world.pose[:, :2] = world.goals.robot_target + np.array([off * world.body.cell_size, 0.0])
    there, still = reward.before(world), np.zeros((4, world.body.action_size), np.float32)
    at = world.body.proprio
    world.proprio[:, at.up_axis] = 0.0, 0.0, 1.0
    worth = []
    for rate in (0.0, 1.0):
        world.proprio[:, at.angular_velocity] = 0.0, 0.0, rate
        worth.append(reward.after(world, there, still, *ends))
    assert (world.goals.kind == GoalKind.HOLD).all()
    assert (task.features()[:, feature_layout(world.body).holds] == 1.0).all()
    return worth[1] - worth[0]


def test_to_turn_is_rewarded_where_no_single_action_does_it():
    assert turning_is_worth("ball") == pytest.approx(np.zeros(4))
    most = RewardConfig().turn * CONTROL_PERIOD
    for off, share in ((0.0, 1.0), (0.15, 0.5), (0.5, 0.0)):
        assert turning_is_worth("ant", off) == pytest.approx(np.full(4, share * most), abs=1e-5)


@pytest.mark.parametrize("body", ["ball", "ant"])
def test_facing_where_it_is_told_to_go_counts_for_a_body_that_no_single_action_turns(body):
    task = make(body=body, planned=1.0, astray=0.0, misaligned=0.0)
    world, config, near = task.world, RewardConfig(), []
    rows = np.flatnonzero(world.goals.kind != GoalKind.HOLD)
    along = OFFSETS_XY[world.goals.direction]
    for off in (0.0, np.pi / 2, -np.pi / 2, np.pi):
        pose = world.pose.astype(np.float64)
        pose[:, 2] = np.arctan2(along[:, 1], along[:, 0]) + off
        world.place(np.arange(world.batch), pose, world.box_position)
        near.append(potential(world, config)[rows])
    worth = config.facing if body == "ant" else 0.0
    assert rows.size and np.array([near[0] - n for n in near]) == pytest.approx(
        worth * np.repeat([[0.0], [0.5], [0.5], [1.0]], rows.size, 1), abs=0.02
    )


@pytest.mark.parametrize(("stays_on", "least", "most"), [(1.0, 1.0, 1.0), (0.0, 0.0, 0.5)])
def test_a_body_that_learns_to_turn_is_told_to_stay_for_long(stays_on, least, most):
    settings = InstructionConfig(stay=0.1, stays_on=stays_on)
    task = make(
        GoalTaskConfig(batch=64, difficulty=1), body="ant", planned=0.0, misaligned=0.0, horizon=np.inf,
        instructions=settings, terminations=EXACT,
    )  # fmt: skip
    after = []
    for _ in range(20):
        stay = task.instruction == Instruction.STAY
        play(task, 1, lambda task: np.zeros((64, task.world.body.action_size), np.float32))
        going_on = stay & task.terminated
        after += (task.instruction == Instruction.STAY)[going_on].tolist()
    assert len(after) > 3 and least <= np.mean(after) <= most


def test_an_episode_begins_with_a_look_around_after_which_the_plan_is_followed():
    task = make(
        GoalTaskConfig(batch=16, difficulty=1), body="ant", planned=1.0, astray=0.0, misaligned=0.0, horizon=np.inf,
        look=12, terminations=EXACT,
    )  # fmt: skip
    stays = []
    for _ in range(20):
        stays.append((task.instruction == Instruction.STAY).mean())
        play(task, 1, lambda task: np.zeros((16, task.world.body.action_size), np.float32))
    assert stays[:12] == [1.0] * 12 and stays[-1] == 0.0
