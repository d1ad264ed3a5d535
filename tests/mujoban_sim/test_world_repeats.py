"""The same level, seed and torques give the same world to the last bit."""

import subprocess
import sys

import numpy as np
import pytest
from rooms import FIRST, SECOND, START, put, random_run, room_world
from safetensors.numpy import load_file, save_file

from mujoban_core.grid import Instruction, cell_to_xy
from mujoban_sim.presets import WORLDS
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import generate_levels


def test_an_episode_does_not_depend_on_history_neighbours_or_threads():
    levels = generate_levels(5, range(4))
    episode = EpisodeSpec(levels[0], 5)
    alone = World(1)
    alone.reset([0], [episode])
    rng = np.random.default_rng(0)
    torques = rng.uniform(-1, 1, (150, 3, 2)).astype(np.float32)
    expected = []
    for t in torques:
        alone.step(t[:1])
        expected.append(alone.qpos[0].copy())
    among = World(3, threads=2)
    among.reset([0, 1, 2], [EpisodeSpec(level, 3) for level in levels[1:]])
    random_run(among, 50, seed=1)
    among.reset([1], [episode])
    for t, qpos in zip(torques, expected, strict=True):
        among.step(t[[1, 0, 2]])
        assert np.array_equal(among.qpos[1], qpos)


def test_an_episode_is_the_same_in_every_process():
    code = (
        "import hashlib, numpy as np\n"
        "from mujoban_sokoban.generator import generate_level\n"
        "from mujoban_sim.world import EpisodeSpec, World\n"
        "world = World(1)\n"
        "world.reset([0], [EpisodeSpec(generate_level(5, 11), 11)])\n"
        "rng = np.random.default_rng(0)\n"
        "for _ in range(200):\n"
        "    world.step(rng.uniform(-1, 1, (1, 2)).astype(np.float32))\n"
        "print(hashlib.sha256(world.qpos.tobytes() + world.proprio.tobytes()).hexdigest())\n"
    )
    digests = {subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
               for _ in range(2)}  # fmt: skip
    assert len(digests) == 1 and digests != {""}


def test_the_eased_world_stays_as_it_was_before_worlds_had_names():
    world = room_world(world="eased")
    put(world, cell_to_xy(START), cell_to_xy(FIRST) + np.array([0.0, 0.06]), cell_to_xy(SECOND), heading=0.1)
    for _ in range(60):
        world.step(np.array([[0.5, -0.02]], np.float32))
    # A box pushed over a cell, two pegs on the way; the robot; the box that was not touched.
    expected = [1.047821081, 1.5035626415, 0.0009723747, -0.5, -0.5, -6.79293e-05,
                0.4465831061, 1.4517335589, -4.5306e-05, -0.130512808, 9.7309054958]  # fmt: skip
    assert world.qpos[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", WORLDS)
def test_a_restored_snapshot_continues_to_the_last_bit_in_any_row_of_another_world(name, tmp_path):
    levels = generate_levels(5, range(3))
    world = World(3, world=name, time_limit=200)
    world.reset([0, 1, 2], [EpisodeSpec(level, i) for i, level in enumerate(levels)])
    instruct = np.array([Instruction.EAST, Instruction.NORTH, Instruction.WEST])
    world.instruct(instruct, np.ones(3, bool))
    random_run(world, 60, seed=1)
    save_file(dict(world.snapshot([2, 0])), tmp_path / "rows.safetensors")
    expected = random_run(world, 150, seed=2)
    again = World(3, world=name, time_limit=200, threads=2)
    again.reset([0, 1, 2], [EpisodeSpec(levels[1], 9)] * 3)
    random_run(again, 20, seed=3)
    again.render(size=16)
    again.restore([0, 2], load_file(tmp_path / "rows.safetensors"))
    assert np.array_equal(again.goals.goal_cell[[2, 0]], world.goals.goal_cell[[0, 2]])
    assert again.episodes[2] == world.episodes[0] and again.episodes[0] == world.episodes[2]
    # The torques of rows 0 and 2 change places with them.
    rng = np.random.default_rng(2)
    for trace in expected:
        again.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32)[[2, 1, 0]])
        found = np.concatenate([again.qpos, again.proprio, again.reward[:, None]], 1)
        assert np.array_equal(found[[2, 0]], trace[[0, 2]])
    for field in ("steps", "truncated", "episode_return", "box_cell", "completed"):
        assert np.array_equal(getattr(again, field)[[2, 0]], getattr(world, field)[[0, 2]])
    assert again.truncated[[0, 2]].all()
    assert np.array_equal(again.render(size=16)[[2, 0]], world.render(size=16)[[0, 2]])


def test_what_is_no_snapshot_of_these_rows_changes_nothing():
    world = room_world()
    kept = world.snapshot([0])
    before = world.qpos.copy()
    for damage, message in (
        ({"qvel": kept["qvel"] * np.nan}, "qvel"), ({"steps": np.zeros(2, np.int64)}, r"steps.*\(2,\)"),
        ({"episode.level": kept["episode.level"][:, :5]}, "."),
        ({"steps": kept["steps"].astype(np.int32)}, "steps of the snapshot is int32"),
        ({"agent_cell": kept["agent_cell"] + 100}, "agent_cell of the snapshot: expected 0 to 9"),
        ({"box_cell": kept["box_cell"] - 100}, "box_cell of the snapshot: expected -1 to 9"),
        ({"goals.box_index": kept["goals.box_index"] + 2}, "box_index of the snapshot: expected 0 to 1"),
        ({"goals.kind": kept["goals.kind"] + 9}, "kind of the snapshot: expected"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            world.restore([0], {**kept, **damage})
    with pytest.raises(ValueError, match="lacks qpos"):
        world.restore([0], {})
    assert np.array_equal(world.qpos, before)
