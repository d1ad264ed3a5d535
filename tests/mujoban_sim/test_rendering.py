import dataclasses
import gc
import importlib
import subprocess
import sys

import numpy as np
import pytest

from mujoban_core.bodies import BALL
from mujoban_core.camera import project
from mujoban_core.grid import cell_to_xy
from mujoban_sim.presets import EASED, REFERENCE
from mujoban_sim.rendering import FrameRenderer, RenderingError
from mujoban_sim.scene import parked_position
from mujoban_sokoban.levels import Level

OPEN = Level.from_text("""\
##########
#        #
#  .     #
#     $  #
#        #
#   @    #
#     .  #
#  $     #
#        #
##########
""")
CRAMPED = Level.from_text("""\
##########
##########
##########
####  ####
####$ ####
####.@####
##########
##########
##########
##########
""")
BATCH, BOXES = 4, 2
COLOURS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0)}


@pytest.fixture(scope="module")
def renderer():
    renderer = FrameRenderer(BATCH, BALL, BOXES, preset=EASED)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def threaded():
    renderer = FrameRenderer(BATCH, BALL, BOXES, threads=2, preset=EASED)
    yield renderer
    renderer.close()


def state(level, pose=None, body=BALL, batch=BATCH):
    """The start of a level in every row; `pose` [3] or [batch, 3] replaces the robot's."""
    qpos = np.zeros((batch, 3 * BOXES + len(body.rest_qpos)))
    for k in range(BOXES):
        present = k < len(level.boxes)
        place = (*cell_to_xy(level.boxes[k], body.cell_size), 0.0) if present else parked_position(k, body.cell_size)
        qpos[:, 3 * k : 3 * k + 3] = place
    start = (*cell_to_xy(level.player, body.cell_size), 0.0)
    for row, p in zip(qpos, np.broadcast_to(start if pose is None else pose, (batch, 3)), strict=True):
        row[3 * BOXES + np.array([0, 1, 3])] = p
    return qpos


def flags(batch=BATCH):
    return np.zeros((batch, BOXES), bool)


def show(renderer, level, seed=0):
    for row in range(renderer.batch):
        renderer.set_episode(row, level, seed)


def name_of(pixel):
    """The colour whose chroma is nearest to a pixel's, or None for anything greyish."""
    rgb = pixel / 255.0
    chroma = rgb - rgb.mean()
    if np.ptp(rgb) < 0.35:
        return None
    return min(COLOURS, key=lambda c: -chroma @ (np.array(COLOURS[c]) - np.mean(COLOURS[c])) / np.std(COLOURS[c]))


def look_at(xy, distance, angle):
    """Pose of a robot that sees a point from a distance, heading for it."""
    return np.array([xy[0] - distance * np.cos(angle), xy[1] - distance * np.sin(angle), angle])


def pixel_at(frame, point, pose):
    u, v = project(np.array([point]), pose, BALL.camera, size=len(frame)).pixels[0]
    return frame[round(v), round(u)]


@pytest.mark.parametrize("angle", [0.0, 1.2, 2.9, -2.0])
@pytest.mark.parametrize("distance", [1.6, 2.5])
def test_a_target_cell_projects_to_red_pixels_and_to_green_ones_when_pressed(renderer, angle, distance):
    show(renderer, OPEN)
    targets = cell_to_xy(np.argwhere(OPEN.target))
    pressed = flags()
    pressed[:, 1] = True
    for target, colour in zip(targets, ("red", "green"), strict=True):
        pose = look_at(target, distance, angle)
        qpos = state(OPEN, pose)
        qpos[:, :6] = np.concatenate([parked_position(k, 1.0) for k in range(BOXES)])
        frame = renderer.render(qpos, pressed, flags(), rows=[0])[0]
        for corner in ((0, 0), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
            assert name_of(pixel_at(frame, (*(target + corner), 0.0), pose)) == colour


@pytest.mark.parametrize("angle", [0.3, 1.9, -2.6])
def test_a_box_is_yellow_and_blue_on_a_target_wherever_it_stands(renderer, angle):
    show(renderer, OPEN)
    on_target = flags()
    on_target[:, 1] = True
    shift = np.array([0.21, -0.13])
    for k, colour in enumerate(("yellow", "blue")):
        box = cell_to_xy(OPEN.boxes[k]) + shift
        pose = look_at(box, 2.0, angle)
        qpos = state(OPEN, pose)
        qpos[:, 3 * k : 3 * k + 2] = box
        frame = renderer.render(qpos, flags(), on_target, rows=[2])[0]
        for point in ((0, 0, 0.3), (0.3, 0.3, 0.3), (-0.3, -0.3, 0.3)):
            assert name_of(pixel_at(frame, (*(box + point[:2]), point[2]), pose)) == colour


def test_the_view_from_above_has_north_up(renderer):
    show(renderer, CRAMPED)
    on_target, pressed = flags(), flags()
    frame = renderer.render(state(CRAMPED), pressed, on_target, rows=[0], camera="top_down")[0]
    at = lambda row, col: frame[int((row + 0.5) * 6.4), int((col + 0.5) * 6.4)]  # noqa: E731
    assert name_of(at(4, 4)) == "yellow"
    assert name_of(at(5, 4)) == "red"
    assert name_of(at(4, 5)) is None
    pushed = state(CRAMPED)
    pushed[:, :2] = cell_to_xy((5, 4))
    frame = renderer.render(pushed, ~pressed, ~on_target, rows=[0], camera="top_down")[0]
    assert name_of(at(5, 4)) == "blue"
    assert name_of(at(4, 4)) is None


def test_the_ears_show_the_heading_from_above(renderer):
    show(renderer, OPEN)
    x, y = cell_to_xy(OPEN.player)
    frame = renderer.render(state(OPEN, (x, y, 0.0)), flags(), flags(), rows=[0], camera="top_down")[0].astype(int)
    redness = frame[..., 0] - frame[..., 2]
    row, col = round((4.5 - y) * 6.4 + 3.2), round((x + 4.5) * 6.4 + 3.2)
    around = redness[row - 3 : row + 3, col - 3 : col + 3]
    # Heading east: the red ear is on the right, so to the south.
    assert around[3:].max() > 60
    assert around[:3].min() < -60


def test_a_frame_depends_on_level_seed_and_state_but_not_on_row_or_threads(renderer, threaded):
    pose = np.array([-1.0, 0.5, 0.4])
    show(renderer, OPEN, 3)
    show(threaded, OPEN, 3)
    frames = renderer.render(state(OPEN, pose), flags(), flags())
    assert (frames == frames[0]).all()
    np.testing.assert_array_equal(frames, threaded.render(state(OPEN, pose), flags(), flags()))


def test_worlds_of_one_batch_show_their_own_level_seed_and_state(threaded):
    poses = np.array([[-1.0, 0.5, 0.4], [0.5, 0.5, 2.0], [-1.0, -2.5, 1.0], [1.5, 0.5, -1.0]])
    levels, seeds = [OPEN, CRAMPED, OPEN, CRAMPED], [1, 2, 3, 1]
    qpos = np.concatenate([state(levels[i], poses[i])[:1] for i in range(BATCH)])
    for row in range(BATCH):
        threaded.set_episode(row, levels[row], seeds[row])
    together = threaded.render(qpos, flags(), flags())
    for row in range(BATCH):
        show(threaded, levels[row], seeds[row])
        alone = threaded.render(np.repeat(qpos[row : row + 1], BATCH, axis=0), flags(), flags(), rows=[0])
        np.testing.assert_array_equal(together[row], alone[0])


def test_rows_come_in_the_order_in_which_they_were_asked_for(threaded):
    show(threaded, OPEN)
    poses = np.array([[-1.0, 0.5, a] for a in range(BATCH)])
    every = threaded.render(state(OPEN, poses), flags(), flags())
    some = threaded.render(state(OPEN, poses), flags(), flags(), rows=[3, 0, 1])
    np.testing.assert_array_equal(some, every[[3, 0, 1]])


def test_a_new_episode_changes_the_textures_but_not_the_skyline(renderer):
    pose = (-1.0, 0.5, 0.4)
    show(renderer, OPEN, 1)
    first = renderer.render(state(OPEN, pose), flags(), flags())[0]
    show(renderer, OPEN, 2)
    second = renderer.render(state(OPEN, pose), flags(), flags())[0]
    np.testing.assert_array_equal(first[:24], second[:24])
    assert np.abs(first[32:].astype(int) - second[32:]).mean() > 10


def test_a_larger_level_can_follow_a_smaller_one_in_the_same_row(renderer):
    show(renderer, OPEN, 5)
    before = renderer.render(state(OPEN), flags(), flags())
    show(renderer, CRAMPED, 5)
    renderer.render(state(CRAMPED), flags(), flags())
    show(renderer, OPEN, 5)
    np.testing.assert_array_equal(renderer.render(state(OPEN), flags(), flags()), before)


def test_leaving_out_what_is_out_of_view_changes_no_pixel(renderer, monkeypatch):
    rng = np.random.default_rng(0)
    show(renderer, OPEN)
    poses = np.concatenate([rng.uniform(-3.5, 3.5, (40, 2)), rng.uniform(-np.pi, np.pi, (40, 1))], axis=-1)
    batches = [state(OPEN, p) for p in poses.reshape(-1, BATCH, 3)]
    culled = [renderer.render(q, flags(), flags()) for q in batches]
    monkeypatch.setattr("mujoban_sim.rendering.in_view", lambda points, *_: np.ones(points.shape[:-1], bool))
    complete = [renderer.render(q, flags(), flags()) for q in batches]
    np.testing.assert_array_equal(culled, complete)


@pytest.mark.parametrize("cell_size", [1.0, 3.0])
def test_frames_have_the_size_asked_for_and_the_world_scales_with_the_body(cell_size):
    body = dataclasses.replace(BALL, cell_size=cell_size)
    renderer = FrameRenderer(1, body, BOXES, size=96, preset=EASED)
    try:
        renderer.set_episode(0, CRAMPED, 0)
        first = renderer.render(state(CRAMPED, body=body, batch=1), flags(1), flags(1))
        above = renderer.render(state(CRAMPED, body=body, batch=1), flags(1), flags(1), camera="top_down")
    finally:
        renderer.close()
    assert first.shape == above.shape == (1, 96, 96, 3)
    assert first.dtype == np.uint8
    assert name_of(above[0, int(5.5 * 9.6), int(4.5 * 9.6)]) == "red"
    assert name_of(above[0, int(4.5 * 9.6), int(4.5 * 9.6)]) == "yellow"


def test_bad_input_is_named(renderer):
    show(renderer, OPEN)
    qpos = state(OPEN)
    with pytest.raises(ValueError, match="unknown camera 'side'"):
        renderer.render(qpos, flags(), flags(), camera="side")
    with pytest.raises(ValueError, match=r"qpos has shape \(4, 3\)"):
        renderer.render(qpos[:, :3], flags(), flags())
    with pytest.raises(ValueError, match="expected values from 0 to 3"):
        renderer.render(qpos, flags(), flags(), rows=[4])
    with pytest.raises(ValueError, match="row is 4"):
        renderer.set_episode(4, OPEN, 0)
    with pytest.raises(ValueError, match="threads is 0"):
        FrameRenderer(1, BALL, 1, threads=0, preset=EASED)


def test_a_row_without_an_episode_is_an_error_and_so_is_a_level_with_too_many_targets():
    renderer = FrameRenderer(1, BALL, 1, preset=EASED)
    try:
        with pytest.raises(ValueError, match="have no episode yet"):
            renderer.render(np.zeros((1, 3 + len(BALL.rest_qpos))), np.zeros((1, 1), bool), np.zeros((1, 1), bool))
        with pytest.raises(ValueError, match="2 targets"):
            renderer.set_episode(0, OPEN, 0)
    finally:
        renderer.close()


def test_without_opengl_the_error_names_the_packages_to_install(monkeypatch):
    def fail(name, *_):
        raise ImportError(f"no {name}")

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(RenderingError, match="libegl1 and libgl1-mesa-dri"):
        FrameRenderer(1, BALL, 1, preset=EASED)


def test_a_renderer_that_the_garbage_collector_frees_does_no_harm_to_another():
    kept = FrameRenderer(1, BALL, BOXES, preset=EASED)
    dropped = FrameRenderer(1, BALL, BOXES, preset=EASED)
    cycle = [dropped]
    cycle.append(cycle)
    del dropped, cycle
    # The collector may run in the thread of any context.
    kept._painters[0].submit(gc.collect).result()
    kept.set_episode(0, CRAMPED, 0)
    frame = kept.render(np.zeros((1, kept._qpos_size)), np.zeros((1, BOXES), bool), np.zeros((1, BOXES), bool))
    assert frame.std() > 0
    kept.close()


WALLED = Level.from_text("""\
##########
#        #
#        #
#    #   #
#@ $ #  .#
#    #   #
#        #
#        #
#        #
##########
""")


@pytest.mark.parametrize(("preset", "seen"), [(REFERENCE, False), (EASED, True)])
def test_full_walls_hide_what_is_behind_them_and_boxes_are_looked_over(preset, seen):
    renderer = FrameRenderer(1, BALL, BOXES, preset=preset)
    try:
        renderer.set_episode(0, WALLED, 0)
        near, far = (-0.5, 0.5, 0.0), (-3.5, 0.5, 0.0)
        behind = renderer.render(state(WALLED, near, batch=1), flags(1), flags(1))[0]
        assert any(name_of(pixel) == "red" for pixel in behind.reshape(-1, 3)) == seen
        over = renderer.render(state(WALLED, far, batch=1), flags(1), flags(1))[0]
        assert name_of(pixel_at(over, (-1.2, 0.5, 0.3), far)) == "yellow"
        assert name_of(pixel_at(over, (0.0, 0.5, 0.3), far)) is None
    finally:
        renderer.close()


def test_drawing_leaves_no_thread_of_low_priority_that_would_hold_up_the_end_of_the_process_on_a_busy_machine():
    program = (
        "import os; from pathlib import Path; from mujoban_sim.rendering import open_context; open_context(64);"
        "tasks = [int(path.name) for path in Path('/proc/self/task').iterdir()];"
        "print({os.getpriority(os.PRIO_PROCESS, task) - os.getpriority(os.PRIO_PROCESS, 0) for task in tasks})"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "{0}\n"
