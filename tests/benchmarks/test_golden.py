"""Whether agents are sound: what the command says of one that had no time to learn."""

import json

import pytest

from benchmarks import golden


@pytest.mark.parametrize("name", ["mpo-asymmetric", "vtrace-structured"])
def test_an_agent_without_time_has_not_passed(name, monkeypatch, capsys):
    monkeypatch.setattr(golden, "_BETWEEN", 1)
    assert golden.main(["--agents", name, "--cpu-minutes", "0.001"]) == 1
    ((told, outcome),) = json.loads(capsys.readouterr().out).items()
    assert told == name and not outcome["passes"] and outcome["solved"] < golden.SOLVED
    assert outcome["steps"] > 0 and outcome["cpu_seconds"] > 0.0 and outcome["curve"][0] == [0, 0.0]


def test_an_agent_has_passed_that_solves_the_task_in_two_looks_in_succession(monkeypatch, capsys):
    seen = iter((0.95, 0.5, 0.9, 0.9, 0.1))
    learner, source = Nothing(), Nothing()
    source.samples = 7
    source.statistics = lambda: {"solved": next(seen)}
    monkeypatch.setitem(golden.AGENTS, "mpo-symmetric", lambda seed: (learner, source))
    assert golden.main(["--agents", "mpo-symmetric", "--seed", "1"]) == 0
    outcome = json.loads(capsys.readouterr().out)["mpo-symmetric"]
    assert outcome["passes"] and outcome["curve"] == [[0, 0.0], [7, 0.95], [7, 0.5], [7, 0.9], [7, 0.9]]


class Nothing:
    """A learner, or a source, that does nothing."""

    def weights(self):
        return {}

    def publish(self, weights, version):
        pass

    def next_batch(self):
        return None

    def update(self, batch, spent, guard):
        pass

    def close(self):
        pass


def test_nobody_and_agents_that_nobody_knows_are_refused():
    with pytest.raises(ValueError, match="--agents nobody: expected some of mpo-asymmetric"):
        golden.main(["--agents", "nobody"])
    with pytest.raises(ValueError, match="cpu_minutes is 0"):
        golden.main(["--cpu-minutes", "0"])
