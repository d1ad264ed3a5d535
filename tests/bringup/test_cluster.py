"""Work that is shared out over a Ray cluster of this machine, for real."""

import json
import os

from toy_actors import die_once

from bringup import evaluate
from bringup.cluster import spread
from mujoban_core.plugins import ROLES


def test_an_evaluation_on_a_cluster_says_the_same_as_one_here(tmp_path, ray_cluster):
    reports = {}
    for name, options in {"here": [], "cluster": ["--cluster", "--num-actors", "2"]}.items():
        file = tmp_path / f"{name}.json"
        episodes = ["--difficulty", "1", "--episodes", "3", "--seed", "40", "--oracle", ",".join(ROLES)]
        assert evaluate.main([*episodes, *options, "--json", str(file)]) == 0
        reports[name] = json.loads(file.read_text())
    assert len(reports["here"]["episodes"]) == 3
    assert reports["here"] == reports["cluster"]


def test_a_job_whose_process_is_killed_is_done_by_another(tmp_path, ray_cluster):
    (pid,) = spread(die_once, [tmp_path / "mark"])
    assert pid != os.getpid()
