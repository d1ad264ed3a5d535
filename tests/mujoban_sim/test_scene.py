import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mujoco.batch import Batch

from mujoban_core.bodies import ANT, BALL
from mujoban_core.bodies.body import ROBOT_BODY
from mujoban_core.grid import cell_to_xy
from mujoban_sim.presets import EASED, REFERENCE, WORLDS, get_world
from mujoban_sim.scene import (
    BOX_MASS,
    SceneCache,
    merge_walls,
    peg_corners,
    scene_mjcf,
)

GRIDS = arrays(np.bool_, (10, 10), elements=st.booleans())


def closed(wall):
    wall = wall.copy()
    wall[[0, -1]] = True
    wall[:, [0, -1]] = True
    return wall


@given(GRIDS)
def test_merged_walls_cover_every_wall_cell_once(wall):
    covered = np.zeros(wall.shape, int)
    for row, col, last_row, last_col in merge_walls(wall):
        covered[row : last_row + 1, col : last_col + 1] += 1
    assert np.array_equal(covered, wall.astype(int))


@given(GRIDS)
def test_a_corner_needs_a_peg_unless_three_walls_meet_there(wall):
    pegs = {tuple(corner) for corner in peg_corners(wall).tolist()}
    for row in range(9):
        for col in range(9):
            assert ((row, col) in pegs) == (wall[row : row + 2, col : col + 2].sum() < 3)


@settings(max_examples=10)
@given(GRIDS)
def test_levels_share_one_layout_whatever_their_walls(wall):
    cache = SceneCache(BALL, 2, EASED)
    first = cache.model(np.zeros((10, 10), bool))
    checkerboard = np.indices((10, 10)).sum(0) % 2 == 0
    batch = Batch(first, nsim=3, nthread=1, persistent=True)
    batch.set_models([cache.model(closed(wall)), cache.model(checkerboard), cache.model(np.ones((10, 10), bool))])


@pytest.mark.parametrize("name", WORLDS)
def test_the_control_period_is_50_ms(name):
    preset = get_world(name)
    model = mujoco.MjModel.from_xml_string(scene_mjcf(np.zeros((10, 10), bool), 1, BALL, preset))
    assert model.opt.timestep == preset.physics_step
    assert pytest.approx(0.05) == preset.substeps * preset.physics_step


def test_an_unknown_world_is_named():
    with pytest.raises(ValueError, match=r"'moon'.*reference, eased"):
        get_world("moon")


@pytest.mark.parametrize(
    ("body", "world", "kilograms"), [(BALL, EASED, 21.0), (BALL, REFERENCE, 22.0), (ANT, REFERENCE, 6.0)]
)
def test_robots_weigh_what_the_guide_says(body, world, kilograms):
    model = mujoco.MjModel.from_xml_string(scene_mjcf(np.zeros((10, 10), bool), 1, body, world))
    assert model.body(ROBOT_BODY).subtreemass[0] == pytest.approx(kilograms, abs=0.3)


def test_boxes_have_their_mass_and_never_turn():
    model = mujoco.MjModel.from_xml_string(scene_mjcf(np.zeros((10, 10), bool), 3, BALL, EASED))
    for k in range(3):
        body = model.body(f"box{k}")
        assert body.mass[0] == pytest.approx(BOX_MASS) == 2.5
        assert (model.jnt_type[body.jntadr[0] :][:3] == mujoco.mjtJoint.mjJNT_SLIDE).all()
        assert body.jntnum[0] == 3


@pytest.mark.parametrize("name", WORLDS)
def test_a_pushed_box_passes_between_pegs_and_stops_at_the_wall(name):
    preset = get_world(name)
    model = mujoco.MjModel.from_xml_string(scene_mjcf(closed(np.zeros((10, 10), bool)), 1, BALL, preset))
    data = mujoco.MjData(model)
    data.qpos[:2] = cell_to_xy((4, 2))
    data.qpos[3:5] = cell_to_xy((8, 8))
    data.qfrc_applied[0] = 30.0
    mujoco.mj_step(model, data, round(4.0 / model.opt.timestep))
    assert data.qpos[0] == pytest.approx(4.0 - 0.4, abs=0.02)
    assert data.qpos[1] == pytest.approx(cell_to_xy((4, 2))[1], abs=0.1)


def box_off_its_lane(preset, offset):
    """Push a box towards the next pair of pegs; return whether it got through, and where it was across its lane."""
    model = mujoco.MjModel.from_xml_string(scene_mjcf(closed(np.zeros((10, 10), bool)), 1, BALL, preset))
    data = mujoco.MjData(model)
    data.qpos[:2] = cell_to_xy((4, 2)) + np.array([0.0, offset])
    data.qpos[3:5] = cell_to_xy((8, 8))
    while data.time < 4.0 and data.qpos[0] < cell_to_xy((4, 3))[0] - 0.1:
        data.qfrc_applied[0] = 30.0 if data.qvel[0] < 1.0 else 0.0
        mujoco.mj_step(model, data)
    return data.time < 4.0, data.qpos[1] - cell_to_xy((4, 2))[1]


@pytest.mark.parametrize(("preset", "offset"), [(EASED, 0.05), (EASED, 0.1), (EASED, 0.12), (REFERENCE, 0.05)])
def test_a_box_off_its_lane_slides_between_the_next_pegs(preset, offset):
    through, across = box_off_its_lane(preset, offset)
    assert through and abs(across) < 0.06


def test_a_plain_box_jams_between_pegs_from_where_one_with_cut_edges_slides_back():
    assert not box_off_its_lane(REFERENCE, 0.12)[0]


def test_a_box_between_cells_is_held_by_pegs():
    model = mujoco.MjModel.from_xml_string(scene_mjcf(closed(np.zeros((10, 10), bool)), 1, BALL, EASED))
    data = mujoco.MjData(model)
    start = cell_to_xy((4, 4)) + np.array([0.0, 0.5])
    data.qpos[:2] = start
    data.qpos[3:5] = cell_to_xy((8, 8))
    data.qfrc_applied[0] = 30.0
    mujoco.mj_step(model, data, round(4.0 / model.opt.timestep))
    assert data.qpos[0] < start[0] + 0.2


def test_scene_cache_compiles_a_level_once_and_drops_the_least_recently_used():
    cache = SceneCache(BALL, 1, EASED, capacity=2)
    walls = [np.zeros((10, 10), bool) for _ in range(3)]
    for i, wall in enumerate(walls):
        wall[i, i] = True
    first, second = cache.model(walls[0]), cache.model(walls[1])
    assert cache.model(walls[0]) is first
    cache.model(walls[2])
    assert cache.model(walls[0]) is first
    assert cache.model(walls[1]) is not second


def test_walls_of_another_shape_are_rejected():
    with pytest.raises(ValueError, match=r"\(7, 7\).*\(10, 10\)"):
        scene_mjcf(np.zeros((7, 7), bool), 1, BALL, EASED)
