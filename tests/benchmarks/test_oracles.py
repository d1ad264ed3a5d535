"""The benchmark of the oracles: what it reports, and which levels it may play."""

import json

import pytest

from benchmarks import oracles
from benchmarks.oracles import Options, run
from mujoban_core.plugins import ROLES
from mujoban_sokoban.generator import TEST_SEEDS, VALIDATION_SEEDS


def test_levels_for_validation_are_played_and_no_use_of_test_levels_is_noted():
    report = run(Options(levels=2, difficulty=1, batch=2, threads=1))
    assert report["n"] == 2 and report["success_rate"] == 1.0 and "test_uses" not in report
    assert report["privileged"] == list(report["weights"]) == list(ROLES)


def test_that_test_levels_were_used_is_noted_before_they_are_played(monkeypatch):
    noted = []

    class Played(Exception):
        pass

    def note(*use):
        noted.append(use)
        return {}

    def play(*_):
        raise Played

    monkeypatch.setattr(oracles, "noted_use", note)
    monkeypatch.setattr(oracles, "ticks", play)
    with pytest.raises(Played):
        run(Options(levels=3, seed=TEST_SEEDS.start, batch=2, threads=1))
    ((seeds, weights, played),) = noted
    assert list(seeds) == list(TEST_SEEDS[:3]) and set(weights.values()) == {"oracle"}
    assert json.loads(json.dumps(played))["difficulty"] == 5


def test_levels_of_two_ranges_are_refused():
    with pytest.raises(ValueError, match=str(VALIDATION_SEEDS.stop - 1)):
        run(Options(levels=4, seed=VALIDATION_SEEDS.stop - 1))
