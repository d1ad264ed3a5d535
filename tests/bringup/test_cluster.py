"""Work that is shared out over a Ray cluster of this machine, for real."""

import json
import os
from types import SimpleNamespace

import numpy as np
from toy_actors import die_once

from bringup import evaluate, record
from bringup.cluster import EveryNth, spread
from bringup.rollout import ticks
from mujoban_baselines.random_agent import RandomAgent
from mujoban_core.agent import AgentPolicy
from mujoban_core.plugins import ROLES
from mujoban_msgs_py.bags import open_bag
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

EPISODES = ["--difficulty", "1", "--episodes", "3", "--oracle", ",".join(ROLES)]


def test_an_evaluation_on_a_cluster_says_the_same_as_one_here(tmp_path, ray_cluster):
    reports = {}
    for name, options in {"here": [], "cluster": ["--cluster", "--num-actors", "2"]}.items():
        file = tmp_path / f"{name}.json"
        assert evaluate.main([*EPISODES, "--time-limit", "150", *options, "--json", str(file)]) == 0
        reports[name] = json.loads(file.read_text())
    assert len(reports["here"]["episodes"]) == 3
    assert reports["here"] == reports["cluster"]


def test_a_share_of_a_run_draws_as_the_whole_does():
    """A cluster's processes play every n-th episode each; who draws at random draws by the episode's number."""
    whole = Episodes(5, VALIDATION_SEEDS.start, difficulty=1)

    def torques(episodes, batch):
        world = World(min(batch, len(episodes)), max_boxes=1, time_limit=3)
        found = {}
        for tick in ticks(AgentPolicy(RandomAgent()), world, episodes):
            for row, index in enumerate(tick.episode.tolist()):
                found.setdefault(episodes[index].seed, []).append(tick.decision.torque[row].tolist())
        return found

    shares = [torques(EveryNth(whole, first, 2), 2) for first in range(2)]
    assert shares[0] | shares[1] == torques(whole, 2)
    parts = [Episodes(2, whole.seed, difficulty=1), Episodes(3, whole.seed + 2, difficulty=1)]
    parts[1].first_number = 3
    assert torques(parts[0], 2) | torques(parts[1], 2) == torques(whole, 2)


def test_a_recording_on_a_cluster_says_the_same_as_one_here(tmp_path, ray_cluster):
    def said(name, *options):
        folder = tmp_path / name
        assert record.main(["--out", str(folder), *EPISODES, "--time-limit", "4", *options]) == 0
        # Not the bytes: those between the fields of a serialised message are what was in memory before.
        return {bag.name: list(open_bag(bag).read()) for bag in folder.iterdir()}

    here = said("here", "--processes", "1")
    assert len(here) == 3 and all(here.values())
    np.testing.assert_equal(here, said("there", "--cluster", "--num-actors", "1"))


def test_a_recording_that_was_cut_off_is_done_again_from_the_start(tmp_path, monkeypatch):
    (tmp_path / "part0_row007").mkdir()
    (tmp_path / "part1_row000").mkdir()
    done = []
    monkeypatch.setattr(record, "record", lambda job: done.append(sorted(f.name for f in tmp_path.iterdir())))
    record.record_again(SimpleNamespace(out=tmp_path, prefix="part0_"))
    assert done == [["part1_row000"]]


def test_a_job_whose_process_is_killed_is_done_by_another(tmp_path, ray_cluster):
    (pid,) = spread(die_once, [tmp_path / "mark"])
    assert pid != os.getpid()
