"""Errors of the estimator about what was seen: counted, and drawn as often."""

import json

import numpy as np
import pytest
import torch

from bringup.command import Choice, Stack
from bringup.record import Job, MixedEpisodes, record
from mujoban_core.grid import AGENT, BOX, TARGET, WALL
from mujoban_core.plugins import ROLES
from mujoban_planner.boards import abstract_states
from mujoban_planner.estimator_errors import DISTANCES, KINDS, MEASURED, ErrorCounts, ErrorRates, Seen, add_errors
from mujoban_planner.measure_errors import main
from mujoban_planner.uncertainty import Uncertainty, UncertaintyConfig, hide_unseen
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

CERTAINTY = 0.5 + 0.5 * np.arange(len(KINDS))


@pytest.fixture(scope="module")
def states():
    states = abstract_states(generate_batch(5, range(TRAIN_SEEDS.start, TRAIN_SEEDS.start + 500)))
    states[::2, ..., BOX] = states[::2, ..., TARGET]
    return states


def rates(shape):
    """Return rates of 1 to 25 %, all different, higher at the edge and from afar."""
    edge, distance, kind = np.arange(2)[:, None], np.arange(DISTANCES), np.arange(len(KINDS))[:, None, None]
    return ErrorRates(0.01 + 0.02 * edge + 0.03 * distance + 0.005 * kind, shape, CERTAINTY)


def counted(states, given, factor=1.0):
    """Return what is counted of errors that are drawn: all states several times, each seen in another way."""
    rng, counts, truth = np.random.default_rng(0), ErrorCounts(), states > 0.5
    for _ in range(8):
        seen = Seen(rng.random(truth.shape[:3]) < 0.8, rng.integers(0, DISTANCES + 3, truth.shape[:3]).astype(float))
        estimate = states.astype(np.float64)
        add_errors(estimate, truth, seen, given, factor, rng)
        assert (estimate[..., AGENT] == states[..., AGENT]).all()
        untouched = ~seen.cells
        untouched[:, [0, -1]] = untouched[:, :, [0, -1]] = True
        assert (estimate[untouched] == states[untouched]).all()
        counts.add(estimate, truth, seen)
    return counts


@pytest.mark.parametrize("shape", [0.3, 3.0])
def test_errors_are_drawn_as_often_as_they_were_counted_where_they_were_and_as_many_together(states, shape):
    given = rates(shape)
    counts = counted(states, given)
    assert counts.states == 8 * len(states)
    many = counts.cells > 3000
    assert many.sum() > 40
    share = counts.wrong / np.maximum(counts.cells, 1)
    np.testing.assert_allclose(share[many], given.rate[many], rtol=0.2, atol=0.005)
    found = counts.rates()
    assert found.shape == pytest.approx(shape, rel=0.2)
    np.testing.assert_allclose(found.certainty, CERTAINTY, rtol=0.15)


def test_errors_that_come_together_leave_more_states_without(states):
    together, alone = (counted(states[:200], rates(shape)).share_with_errors for shape in (0.3, 30.0))
    assert together < alone - 0.1


def test_a_factor_makes_errors_as_many_times_as_frequent(states):
    few, many = (counted(states[:200], rates(5.0), factor).wrong.sum() for factor in (0.1, 0.2))
    assert many / few == pytest.approx(2.0, rel=0.15)


def test_states_as_estimated_have_as_many_errors_as_were_measured(states):
    measured = json.loads(MEASURED.read_text())
    truth = torch.from_numpy(states)
    clean, wrong = (hide_unseen(truth, 1.0, np.random.default_rng(0), given) for given in (None, ErrorRates.read()))
    changed = (clean > 0.5) != (wrong > 0.5)
    assert not changed[..., AGENT].any()
    for layer in (WALL, TARGET, BOX):
        right = (clean[..., layer] > 0.5) == (truth[..., layer] > 0.5)
        assert (changed[..., layer] <= right).all(), "of what was right"
    assert 0.3 < changed[..., WALL].float().sum((1, 2)).mean() < 0.9, "0.58 were measured"
    assert 0.1 < changed[..., TARGET].float().sum((1, 2)).mean() < 0.4, "0.23 were measured"
    share = changed.flatten(1).any(1).float().mean()
    assert share == pytest.approx(measured["with_errors"], abs=0.12)


def test_an_option_makes_the_states_of_a_batch_wrong(states):
    truth = torch.from_numpy(states[:100])

    def shown(errors):
        config = UncertaintyConfig(hidden=0.5, errors=errors)
        return Uncertainty(config).apply(truth, torch.Generator(), np.random.default_rng(0))

    none, some = shown(0.0), shown(1.0)
    assert torch.equal(none, hide_unseen(truth, 0.5, np.random.default_rng(0))), "off by default"
    assert torch.equal(some[:50], truth[:50]) and not torch.equal(some, none)
    with pytest.raises(ValueError, match=r"errors is -1\.0: expected"):
        UncertaintyConfig(errors=-1.0)


def test_what_is_asked_of_states_that_a_batch_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"^errors is 1\.0: expected 0, or a --hidden above 0, whose"):
        UncertaintyConfig(noise=0.1, errors=1.0)
    with pytest.raises(ValueError, match=r"^noise is 0\.7 and hidden 0\.4: expected at most 1 together$"):
        UncertaintyConfig(noise=0.7, hidden=0.4)
    assert UncertaintyConfig(noise=0.6, hidden=0.4, errors=1.0).shows_estimates


def test_rates_that_are_none_are_refused_in_words(tmp_path):
    path = tmp_path / "rates.json"
    for text in ("{", "{}", json.dumps(ErrorRates.read()._replace(shape=-1.0).report)):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"rates\.json: .*rates of errors.*expected what `python -m"):
            ErrorRates.read(path)


def test_the_command_counts_in_bags(tmp_path, capsys):
    stack = Stack({role: Choice(role, "oracle") for role in ROLES})
    record(Job(tmp_path / "bag", "", MixedEpisodes(1, TRAIN_SEEDS.start, [2]), stack, None, 1, 400, 0))
    report = tmp_path / "rates.json"
    assert main(["--bags", str(tmp_path / "bag"), "--json", str(report)]) == 0
    found = json.loads(report.read_text())
    assert found["with_errors"] == 0.0, "the oracle is right about what it shows"
    moves = capsys.readouterr().out.rsplit("\n", 2)[-2]
    assert moves == f"{found['decisions']} decisions to move, an error in 0.0% of them" and found["decisions"] > 2
    assert (ErrorRates.read(report).rate < 0.06).all()
