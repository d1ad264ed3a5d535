import copy
import json
import os
import shutil

import numpy as np
import pytest
import torch

import mujoban_planner
from mujoban_core.files import digest
from mujoban_planner import symmetry
from mujoban_planner.boards import abstract_states, bit_boards, take_levels
from mujoban_planner.decision import count_visits, initial_means, initial_visits
from mujoban_planner.export import export
from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner
from mujoban_planner.play import play
from mujoban_planner.search import evaluate_boards
from mujoban_rl.compiled import graph_path
from mujoban_rl.weights import WeightsError, save_weights
from mujoban_sokoban.generator import generate_batch

LEVELS = generate_batch(5, range(1000, 1004))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Folder with the weights of a small planner, their record and graph."""
    torch.manual_seed(0)
    planner = RecurrentPlanner(4, 1, 1)
    folder = tmp_path_factory.mktemp("exported")
    save_weights(folder / "small.safetensors", planner, planner.config, {})
    export(folder / "small.safetensors")
    return folder


@pytest.fixture
def small(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "copy") / "small.safetensors"


def _scores(planner, states):
    return planner.scores(states, count_visits(states, initial_visits(1)), initial_means(1))[0]


def test_shipped_planner_decides_in_its_graph_as_in_pytorch():
    compiled, plain = mujoban_planner.load(), mujoban_planner.load()
    assert compiled.compiled is not None
    plain.compiled = None
    rng = np.random.default_rng(0)
    for state in abstract_states(LEVELS):
        blurred = np.clip(state + rng.normal(0.0, 0.1, state.shape), 0, 1).astype(np.float32)[None]
        a, b = (p.initial_state(np.zeros(1, np.int64)).memory for p in (compiled, plain))
        for _ in range(10):  # The memory turns the board and weighs what was tried
            (decision, a), (expected, b) = compiled.decide(blurred, a), plain.decide(blurred, b)
            assert decision == expected
            assert all(np.allclose(x, y, atol=0.05, rtol=1e-4) for x, y in zip(a, b, strict=True))


def _judged_alike(compiled, plain, monkeypatch):
    monkeypatch.setattr(compiled, "read", lambda state: pytest.fail("it has a graph for one state"))
    for i in range(len(LEVELS.wall)):
        boards = bit_boards(take_levels(LEVELS, np.array([i])))
        for said, expected in zip(evaluate_boards(compiled, boards), evaluate_boards(plain, boards), strict=True):
            assert np.allclose(said, expected, atol=1e-3)


def test_a_search_judges_one_state_by_the_graph_as_in_pytorch(monkeypatch):
    _judged_alike(mujoban_planner.load(), mujoban_planner.load(compiled=False), monkeypatch)


@pytest.mark.parametrize("judge", [True, False])
def test_longer_thinking_that_sees_more_views_leaves_a_search_its_graph(judge, tmp_path, monkeypatch):
    torch.manual_seed(0)
    planner, path = ResidualPlanner(4, 1, judge=judge), tmp_path / "small.safetensors"
    save_weights(path, planner, planner.config, {})
    export(path)
    compiled, plain = mujoban_planner.load(path), mujoban_planner.load(path, compiled=False)
    for views in (1, 4):
        compiled.thinking = plain.thinking = views
        _judged_alike(compiled, plain, monkeypatch)


def test_shipped_graph_solves_levels_one_by_one():
    planner = mujoban_planner.load()
    alone = [play(planner, generate_batch(3, [seed])).solved[0] for seed in range(1000, 1004)]
    assert alone == [True] * 4


def test_an_exported_planner_decides_as_before(small):
    exported = mujoban_planner.load(small)
    graph_path(small).unlink()
    bare = mujoban_planner.load(small)
    assert exported.compiled is not None and bare.compiled is None
    for state in abstract_states(LEVELS):
        assert np.allclose(_scores(exported, state[None]), _scores(bare, state[None]), atol=1e-4)


def test_a_graph_bears_no_trace_of_the_machine(small):
    content = graph_path(small).read_bytes()
    assert b".py" not in content and b"/mujoban" not in content


def test_a_graph_of_other_weights_is_not_used(small):
    with torch.no_grad():
        other = RecurrentPlanner(4, 1, 1)
    save_weights(small, other, other.config, {})
    with pytest.warns(UserWarning, match=r"small\.onnx: a graph of other weights .*bringup\.export"):
        planner = mujoban_planner.load(small)
    state = abstract_states(LEVELS)[:1]
    assert np.allclose(_scores(planner, state), _scores(other.eval(), state), atol=1e-5)


def test_weights_that_were_trained_on_are_not_decided_with_in_the_old_graph(small):
    planner = mujoban_planner.load(small)
    state = abstract_states(LEVELS)[:1]
    before = _scores(planner, state)
    planner.train()
    with torch.no_grad():
        for weight in planner.parameters():
            weight += 0.1
    assert not np.allclose(_scores(planner.eval(), state), before, atol=1e-2)


def test_more_thinking_time_is_not_that_of_the_graph(small):
    planner = mujoban_planner.load(small)
    state = abstract_states(LEVELS)[:1]
    before = _scores(planner, state)
    planner.thinking = 4
    assert not np.allclose(_scores(planner, state), before, atol=1e-3)
    boards = bit_boards(take_levels(LEVELS, np.array([0, 0])))
    one = type(boards)._make(column[:1] for column in boards)
    for alone, both in zip(evaluate_boards(planner, one), evaluate_boards(planner, boards), strict=True):
        assert np.allclose(alone[0], both[0], atol=1e-4), "a search that is alone thinks as those side by side"


def test_a_copy_has_the_graph_as_well(small):
    planner = mujoban_planner.load(small)
    state = abstract_states(LEVELS)[:1]
    twin = copy.deepcopy(planner)
    assert twin.compiled is not None and np.array_equal(_scores(twin, state), _scores(planner, state))


def test_what_is_no_graph_of_a_decision_is_named(small):
    graph_path(small).write_bytes(b"no graph")
    with pytest.raises(WeightsError, match=r"small\.onnx: damaged .*bringup\.export"):
        mujoban_planner.load(small)


def test_an_export_that_is_the_first_use_of_a_planner_spoils_no_later_one(tmp_path):
    for kept in (symmetry._view_sources, symmetry._instruction_images, symmetry.push_images):
        kept.cache_clear()
    planner, path = ResidualPlanner(4, 1), tmp_path / "small.safetensors"
    save_weights(path, planner, planner.config, {})
    export(path)
    decision, _ = planner.decide(abstract_states(LEVELS), planner.initial_memory(len(LEVELS.wall)))
    assert decision.shape == (len(LEVELS.wall),)


def test_an_export_takes_the_place_of_a_damaged_graph(small, recwarn):
    graph_path(small).write_bytes(b"no graph")
    export(small)
    assert mujoban_planner.load(small).compiled is not None
    assert not [w for w in recwarn if "other weights" in str(w.message)]


def test_no_flipped_bit_of_a_graph_is_decided_with(small):
    rng, whole = np.random.default_rng(0), graph_path(small).read_bytes()
    for _ in range(50):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        graph_path(small).write_bytes(data)
        with pytest.raises(WeightsError, match=r"small\.onnx: damaged or not the graph of its record"):
            mujoban_planner.load(small)


def test_a_graph_that_says_something_else_than_the_weights_is_refused(small):
    other = mujoban_planner.load(small, compiled=False)
    with torch.no_grad():
        for weight in other.parameters():
            weight.neg_()
    save_weights(small, other, other.config, {})
    record = json.loads(small.with_suffix(".json").read_text())
    small.with_suffix(".json").write_text(json.dumps(record | {"graph": digest(graph_path(small))}))
    with pytest.raises(WeightsError, match=r"small\.onnx: its \w+ is not that of the weights"):
        mujoban_planner.load(small)


def test_onnx_runtime_sends_nothing_home(small, monkeypatch):
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    mujoban_planner.load(small)
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"
