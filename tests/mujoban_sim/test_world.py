import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import FIRST, ROOM, SECOND, START, TARGETS, put, random_run, rest, room_world

from mujoban_core.bodies import BALL, BODIES, Motor, Relabelling
from mujoban_core.grid import AGENT, BOX, TARGET, WALL, Instruction, cell_to_xy, xy_to_cell
from mujoban_sim.checks import TorqueError
from mujoban_sim.goals import GoalKind
from mujoban_sim.presets import WORLDS
from mujoban_sim.world import World, initial_heading
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import generate_levels
from mujoban_sokoban.levels import Level


def test_an_episode_starts_as_its_level_says_and_at_rest():
    world = room_world()
    assert np.allclose(world.pose[0, :2], cell_to_xy(START))
    assert np.allclose(world.box_position[0], cell_to_xy(ROOM.boxes))
    assert world.agent_cell[0].tolist() == list(START)
    assert np.allclose(world.proprio[0, world.body.proprio.linear_acceleration], [0, 0, 9.81], atol=1e-3)
    assert not world.velocity.any()
    rest(world, 40)
    assert np.allclose(world.pose[0, :2], cell_to_xy(START), atol=1e-4)


def test_the_heading_comes_from_the_episodes_seed():
    world = World(3, max_boxes=2)
    world.reset([0, 1, 2], [EpisodeSpec(ROOM, seed) for seed in (1, 2, 1)])
    assert world.pose[0, 2] == world.pose[2, 2] != world.pose[1, 2]
    headings = []
    for seed in range(60):
        world.reset([0], [EpisodeSpec(ROOM, seed)])
        headings.append(world.pose[0, 2])
    assert min(headings) < -2 and max(headings) > 2


def test_proprioception_has_the_documented_layout():
    world = room_world()
    put(world, (0.5, 0.5), (-3.5, 3.5), (3.5, 3.5), heading=np.pi / 2)
    for _ in range(20):
        world.step(np.array([[0.5, 0.0]], np.float32))
    proprio, velocity = world.proprio[0], world.velocity[0]
    assert proprio.shape == (BALL.proprio_size,)
    # Heading north, velocity in the robot's frame is forwards.
    assert velocity[1] > 0.5 and abs(velocity[0]) < 0.05
    assert proprio[0] == pytest.approx(velocity[1], abs=1e-3)
    assert proprio[10] == pytest.approx(np.pi / 2, abs=0.05)
    # The ball of radius 0.2 rolls without much slip.
    assert proprio[11] * 0.2 == pytest.approx(velocity[1], rel=0.1)
    assert proprio[13:].tolist() == [0.0, 0.0, 1.0]


def test_positive_steering_turns_left_and_hinges_are_wrapped():
    world = room_world()
    put(world, (0.5, 0.5), (-3.5, 3.5), (3.5, 3.5), heading=3.0)
    for _ in range(10):
        world.step(np.array([[0.0, 0.5]], np.float32))
    assert world.velocity[0, 2] > 0.5
    assert -np.pi <= world.pose[0, 2] < -2.0
    assert world.proprio[0, 10] == pytest.approx(world.pose[0, 2])


def test_a_box_is_on_a_target_when_half_of_it_in_both_axes_is_on_the_pad():
    world = room_world()
    pad = cell_to_xy(TARGETS[0])
    for offset, on in (((0.49, 0.0), True), ((0.51, 0.0), False), ((0.49, -0.49), True), ((0.49, -0.51), False)):
        put(world, (-3.5, -3.5), pad + offset, (3.5, -3.5))
        assert world.box_on_target[0].tolist() == [on, False]


def test_two_boxes_side_by_side_on_one_pad_count_as_one():
    """A robot that rolls on pushes both: the level is not solved while its other pad is empty."""
    level = Level.from_text("##########\n#        #\n#@ $*   .#\n#        #\n##########")
    world = World(1, max_boxes=2)
    world.reset([0], [EpisodeSpec(level, 0)])
    world.place([0], [[*cell_to_xy(level.player), 0.0]], cell_to_xy(level.boxes)[None])
    twice = False
    for _ in range(60):
        world.step(np.array([[1.0, 0.0]], np.float32))
        twice |= bool(world.box_on_target[0].all())
        assert world.boxes_on_target[0] <= 1 and not world.done[0]
    assert twice, "both were on the pad at once"
    state = world.abstract_state()[0]
    assert world.boxes_on_target[0] == (state[..., BOX] * state[..., TARGET]).sum()


def test_rewards_for_boxes_onto_and_off_targets_and_for_solving():
    world = room_world()
    far = cell_to_xy((8, 8))
    rest(world)
    assert world.reward[0] == 0.0
    # `place` gives no reward; the robot then pushes the box over the edge of the pad.
    pad = cell_to_xy(TARGETS[0])
    put(world, pad - [1.15, 0.0], pad - [0.52, 0.0], far)
    total = 0.0
    for _ in range(30):
        world.step(np.array([[0.5, 0.0]], np.float32))
        total += world.reward[0]
        if world.reward[0]:
            break
    assert world.reward[0] == 1.0 and world.boxes_on_target[0] == 1
    for _ in range(60):
        world.step(np.array([[0.8, 0.0]], np.float32))
        if world.reward[0]:
            break
    assert world.reward[0] == -1.0 and not world.box_on_target.any()
    assert world.episode_return[0] == 0.0


def test_solving_gives_ten_more_and_ends_the_episode():
    world = room_world()
    pad = cell_to_xy(TARGETS[0])
    put(world, pad - [1.15, 0.0], pad - [0.52, 0.0], cell_to_xy(TARGETS[1]))
    for _ in range(30):
        world.step(np.array([[0.5, 0.0]], np.float32))
        if world.solved[0]:
            break
    assert world.solved[0] and not world.truncated[0]
    assert world.reward[0] == 11.0 == world.episode_return[0]
    steps = world.steps[0]
    for _ in range(40):
        world.step(np.array([[0.8, 0.0]], np.float32))
        assert world.reward[0] == 0.0
    assert world.solved[0] and world.steps[0] == steps and world.episode_return[0] == 11.0


def test_the_time_limit_truncates():
    world = room_world(time_limit=3)
    rest(world, 2)
    assert not world.done[0]
    rest(world)
    assert world.truncated[0] and not world.solved[0] and world.steps[0] == 3


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1.001, -2.0])
def test_a_bad_torque_is_rejected_and_nothing_moves(bad):
    world = room_world()
    rest(world, 3)
    before, steps = world.qpos.copy(), world.steps.copy()
    torque = np.array([[0.5, bad]], np.float32)
    with pytest.raises(TorqueError, match=r"actuator 1 in row 0.*\[-1, 1\]"):
        world.step(torque)
    assert np.array_equal(world.qpos, before) and np.array_equal(world.steps, steps)
    rest(world)
    assert np.isfinite(world.qpos).all()
    with pytest.raises(TorqueError, match=r"\(2,\).*\(1, 2\)"):
        world.step(np.zeros(2, np.float32))


@pytest.mark.parametrize("name", WORLDS)
def test_random_torques_never_throw_anything_out_of_the_grid(name):
    batch, steps = 64, 250
    world = World(batch, world=name, time_limit=10**9)
    levels = generate_levels(5, range(batch))
    world.reset(np.arange(batch), [EpisodeSpec(level, i) for i, level in enumerate(levels)])
    rng = np.random.default_rng(0)
    rows = np.arange(batch)
    torque = np.zeros((batch, 2), np.float32)
    for t in range(steps):
        if t % 10 == 0:
            # Torques that last and are often extreme push boxes hardest.
            torque = np.clip(rng.normal(0, 1.5, (batch, 2)), -1, 1).astype(np.float32)
        world.step(torque)
        cell = xy_to_cell(world.pose[:, :2])
        assert not world.wall[rows, cell[:, 0], cell[:, 1]].any()
        box = xy_to_cell(world.box_position)
        assert not world.wall[rows[:, None], box[..., 0], box[..., 1]].any()
        assert np.abs(world.velocity).max() < 50 and world.box_speed.max() < 10


def test_abstract_state_of_a_fresh_episode_is_the_levels():
    for level in generate_levels(3, range(20)):
        world = World(1, max_boxes=4)
        world.reset([0], [EpisodeSpec(level, 0)])
        assert np.array_equal(world.abstract_state()[0], level.abstract_state())


def test_an_agent_that_rounds_into_a_boxs_cell_keeps_its_last_cell():
    world = room_world()
    put(world, cell_to_xy(START), cell_to_xy(FIRST), cell_to_xy(SECOND))
    assert world.agent_cell[0].tolist() == list(START)
    # Push: the robot's centre crosses into the box's cell before the box's centre leaves it.
    for _ in range(60):
        world.step(np.array([[0.4, 0.0]], np.float32))
        agent, box = world.agent_cell[0], world.box_cell[0, 0]
        assert agent.tolist() != box.tolist()
        state = world.abstract_state()[0]
        assert state[..., AGENT].sum() == 1 and state[..., BOX].sum() == 2
        assert not (state[..., AGENT] * state[..., BOX]).any()


def test_boxes_that_a_level_lacks_are_far_away_and_stay_there():
    level = Level.from_text("#####\n#@$.#\n#####\n")
    world = World(1, max_boxes=4)
    world.reset([0], [EpisodeSpec(level, 0)])
    random_run(world, 50, seed=0)
    assert world.box_count[0] == 1
    assert (np.abs(world.box_position[0, 1:]) > 50).all()
    assert (world.box_cell[0, 1:] == -1).all()
    assert world.abstract_state()[0, ..., BOX].sum() == 1
    assert world.abstract_state()[0, ..., TARGET].sum() == 1


def test_a_level_with_one_box_is_solved_by_that_box_alone():
    level = Level.from_text("######\n#@$ .#\n######\n")
    world = World(1, max_boxes=3)
    world.reset([0], [EpisodeSpec(level, 0)])
    x, y = cell_to_xy(level.player)
    world.place([0], [[x, y, 0.0]], world.box_position)
    for _ in range(100):
        world.step(np.array([[0.8, 0.0]], np.float32))
    assert world.solved[0] and world.episode_return[0] == 11.0


def test_completion_follows_the_instruction_in_force():
    world = room_world()
    put(world, cell_to_xy(START), cell_to_xy(FIRST), cell_to_xy(SECOND))
    world.instruct(np.array([Instruction.EAST]), np.array([True]))
    assert world.goals.kind[0] == GoalKind.PUSH and not world.completed[0]
    done_at = None
    for t in range(80):
        left = cell_to_xy((3, 5))[0] - world.box_position[0, 0, 0]
        speed = np.clip(3 * left, 0.0, 1.0)
        roll = np.clip(speed + 0.5 * (speed - world.proprio[0, 0]), -1.0, 1.0)
        world.instruct(np.array([Instruction.EAST]), np.array([False]))
        world.step(np.array([[roll, 0.0]], np.float32))
        if world.completed[0]:
            done_at = t
            break
    assert done_at is not None
    assert abs(world.box_position[0, 0, 0] - cell_to_xy((3, 5))[0]) < 0.1 and world.box_speed[0, 0] < 0.3


def test_a_robot_that_is_placed_in_another_cell_is_in_that_one_alone():
    world = room_world()
    put(world, cell_to_xy((7, 2)), cell_to_xy(FIRST), cell_to_xy(SECOND))
    for _ in range(2):
        assert np.argwhere(world.abstract_state()[0, ..., AGENT]).tolist() == [[7, 2]]
        rest(world)


@pytest.mark.parametrize(
    ("robot", "box", "named"), [((138.5, 0.0), (0.5, 0.5), "pose"), ((0.5, 0.5), (0.0, -5.6), "box_position")]
)
def test_what_is_placed_off_the_grid_is_refused_and_nothing_moves(robot, box, named):
    world = World(2, max_boxes=2)
    world.reset([0, 1], [EpisodeSpec(ROOM, 7)] * 2)
    before = world.abstract_state()
    with pytest.raises(ValueError, match=f"{named} .* is off the grid: expected x and y within 5.0 m"):
        put(world, robot, box, cell_to_xy(SECOND))
    assert np.array_equal(world.abstract_state(), before)


def test_truth_and_proprioception_are_copies():
    world = room_world()
    truth, before = world.truth(), world.truth().pose.copy()
    world.step(np.ones((1, 2), np.float32))
    rest(world, 5)
    assert np.array_equal(truth.pose, before) and not np.array_equal(world.pose, before)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="batch is 0"):
        World(0)
    with pytest.raises(ValueError, match="unknown body 'car'"):
        World(1, body="car")
    for limit in (0, math.nan, 2.5):
        with pytest.raises(ValueError, match=f"time_limit is {limit}: expected a whole number of steps, at least 1"):
            World(1, time_limit=limit)
    world = World(2, max_boxes=1)
    with pytest.raises(ValueError, match=r"2 boxes.*max_boxes = 1"):
        world.reset([0], [EpisodeSpec(ROOM, 0)])
    with pytest.raises(RuntimeError, match="reset"):
        world.step(np.zeros((2, 2), np.float32))
    with pytest.raises(ValueError, match="rows"):
        world.reset([2], [EpisodeSpec(ROOM, 0)])
    with pytest.raises(ValueError, match="each once"):
        world.reset([1, 1], [EpisodeSpec(ROOM, 0)] * 2)
    with pytest.raises(ValueError, match="not finite"):
        room_world().place([0], [[np.nan, 0, 0]], np.zeros((1, 2, 2)))


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(1, 5))
def test_walls_of_the_world_are_the_levels(seed, difficulty):
    level = generate_levels(difficulty, [seed])[0]
    world = World(1)
    world.reset([0], [EpisodeSpec(level, seed)])
    assert np.array_equal(world.abstract_state()[0, ..., WALL] > 0, level.wall)


def test_the_simulation_needs_neither_torch_nor_ros():
    code = (
        "import sys, mujoban_sim.env, mujoban_sim.vector_env, mujoban_sim.oracles, mujoban_sim.rendering\n"
        "loaded = {'torch', 'rclpy'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_another_body_needs_no_more_than_its_description(monkeypatch):
    mjcf = """
    <body name="robot" pos="0 0 0.3"><freejoint name="root"/><site name="imu"/><camera name="first_person"/>
      <geom class="robot" type="box" size="0.4 0.4 0.1" mass="8"/>
      <body name="arm" pos="0.3 0 0.2"><joint name="arm" type="hinge" axis="0 0 1" damping="1"/>
        <geom class="robot_visual" type="sphere" size="0.1"/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
      </body>
    </body>"""
    sled = dataclasses.replace(
        BALL, name="sled", root="free", joints=("arm",), joint_qpos=(7,), joint_qvel=(6,),
        joint_range=(None,), mirror=Relabelling((0,), (-1.0,)),
        actuators=(Motor("arm", 10.0),), rest_qpos=(0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0, 0.0), cell_size=3.0,
        time_limit=9600, mjcf=mjcf,
    )  # fmt: skip
    monkeypatch.setitem(BODIES, "sled", sled)
    world = World(2, body="sled", max_boxes=2)
    world.reset([0, 1], [EpisodeSpec(ROOM, seed) for seed in (7, 8)])
    assert world.time_limit == 9600
    assert np.allclose(world.pose[:, :2], 3 * cell_to_xy(START), atol=1e-5)
    assert np.allclose(world.pose[:, 2], [initial_heading(7), initial_heading(8)], atol=1e-3)
    assert np.allclose(world.box_position, 3 * cell_to_xy(ROOM.boxes))
    assert world.agent_cell.tolist() == [list(START)] * 2
    world.instruct(np.array([Instruction.SOUTH, Instruction.EAST]), np.array([True, True]))
    assert world.goals.kind.tolist() == [GoalKind.MOVE, GoalKind.PUSH]
    assert np.allclose(world.goals.box_target[1], 3 * cell_to_xy((3, 5)))
    for _ in range(20):
        world.step(np.full((2, 1), 0.5, np.float32))
    assert world.proprio.shape == (2, 14)
    # The arm turns, its joint is observed, and the robot stands upright.
    assert (world.proprio[:, world.body.proprio.joint_velocity] > 0.5).all()
    assert np.allclose(world.proprio[:, world.body.proprio.up_axis], [0, 0, 1], atol=0.02)


def test_a_level_may_have_any_number_of_boxes():
    rows = ["##########", "#@$$$$$$$#", *["#$$$$$$$$#"] * 3, *["#........#"] * 3, "#....... #", "##########"]
    level = Level.from_text("\n".join(rows) + "\n")
    world = World(1, max_boxes=len(level.boxes))
    world.reset([0], [EpisodeSpec(level, 0)])
    random_run(world, 50, seed=0)
    assert np.array_equal(world.box_cell[0], level.boxes)
