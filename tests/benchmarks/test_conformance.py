import json
from functools import partial

import numpy as np
import pytest

from benchmarks import conformance
from mujoban_core.program import exit_status
from mujoban_sim.presets import EASED, REFERENCE

LEVEL = "\n".join(["##########", *["#        #"] * 3, "# @ $ .  #", *["#        #"] * 4, "##########"])


def run_entry(kind, torque, offset=0.0, steps=40):
    states = np.zeros((steps + 1, 5)).tolist()
    return {
        "kind": kind, "level": LEVEL, "pose": [-2.5, 0.5 + offset, 0.0], "boxes": [[-0.5, 0.5 + offset]],
        "torque": [torque] * steps, "states": states, "states_1ms": states,
    }  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Runs whose recorded states are what the reference world makes of them."""
    entries = [
        run_entry("steer", [0.1, 0.3]), run_entry("push", [0.7, 0.0]), run_entry("off_lane", [0.7, 0.0], offset=0.12)
    ]  # fmt: skip
    folder = tmp_path_factory.mktemp("runs")
    (folder / "runs.json").write_text(json.dumps(entries))
    played = conformance.play(conformance.read_runs(folder), "reference")
    for entry, states in zip(entries, played, strict=True):
        entry["states"] = entry["states_1ms"] = states.tolist()
    (folder / "runs.json").write_text(json.dumps(entries))
    return folder


def test_a_world_conforms_to_its_own_runs_and_another_does_not(recorded):
    runs = conformance.read_runs(recorded)
    same = conformance.compare(runs, conformance.play(runs, REFERENCE.name))
    assert (same["conform"], same["same_outcome"], same["outcomes"]) == (3, 1, 1)
    other = conformance.compare(runs, conformance.play(runs, EASED.name))
    # The robot turns much further where its ball has little torsional friction, and cut edges let the box back in.
    assert other["kinds"]["steer"]["conform"] == 0
    assert other["same_outcome"] == 0
    assert "run 2 (off_lane)" in conformance.table(other) and "instead of jammed, off lane" in conformance.table(other)


def test_a_folder_without_runs_and_a_malformed_file_are_one_line(tmp_path, capsys):
    run = partial(conformance.main, [str(tmp_path)])
    assert exit_status("conformance", run) == 2
    (tmp_path / "runs.json").write_text('[{"kind": "push"}]')
    assert exit_status("conformance", run) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 2 and "not a list of recorded runs" in error[1]
