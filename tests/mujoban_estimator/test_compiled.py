import numpy as np
import pytest
import torch

import mujoban_estimator
from mujoban_core.bodies import get_body
from mujoban_core.files import digest
from mujoban_core.interfaces import EstimatorInput, TerminationInput
from mujoban_estimator.estimator import StateEstimator, probabilities
from mujoban_estimator.export import export_estimator, export_termination
from mujoban_estimator.termination import ControlTermination, parts_of
from mujoban_rl.compiled import CompiledGraph, Signature, graph_path
from mujoban_rl.export import export_graph
from mujoban_rl.testing import robot_ticks
from mujoban_rl.weights import save_weights


@pytest.mark.parametrize("body", ["ball", "ant"])
def test_beta_follows_from_the_graph_as_in_pytorch(tmp_path, body):
    if body == "ball":
        weights = mujoban_estimator.SHIPPED_TERMINATION
    else:
        torch.manual_seed(0)
        small = ControlTermination(body=body, stem=8, channels=8, blocks=1, camera=8, hidden=8)
        weights = tmp_path / "termination.safetensors"
        save_weights(weights, small, small.hyperparameters(), {})
        export_termination(weights)
    compiled = mujoban_estimator.load_termination(weights)
    plain = mujoban_estimator.load_termination(weights, compiled=False)
    assert compiled.compiled is not None and plain.compiled is None
    a, b = compiled.initial_memory(1), plain.initial_memory(1)
    size = get_body(body).proprio_size
    for inputs in robot_ticks(TerminationInput, 30, size, np.random.default_rng(0)):
        (said, a), (expected, b) = compiled.probability(inputs, a), plain.probability(inputs, b)
        assert said.shape == (1,) and np.allclose(said, expected, atol=1e-3)
        pairs = list(zip(parts_of(a), parts_of(b), strict=True))
        assert all(x.shape == y.shape and np.allclose(x, y, atol=1e-3) for x, y in pairs)


@pytest.mark.parametrize("body", ["ball", "ant"])
def test_the_estimate_follows_from_the_graph_as_in_pytorch(tmp_path, body):
    if body == "ball":
        weights = mujoban_estimator.SHIPPED
    else:
        torch.manual_seed(0)
        small = StateEstimator(body=body, stem=8, channels=8, blocks=1, belief=8, embedding=8)
        weights = tmp_path / "estimator.safetensors"
        save_weights(weights, small, small.hyperparameters(), {})
        export_estimator(weights)
    compiled, plain = mujoban_estimator.load(weights), mujoban_estimator.load(weights, compiled=False)
    assert compiled.compiled is not None and plain.compiled is None
    a, b = compiled.initial_memory(1), plain.initial_memory(1)
    rng, cell = np.random.default_rng(0), plain.body.cell_size
    for _ in range(12):
        pose = np.array([[*rng.uniform(-3.0, 3.0, 2) * cell, rng.uniform(-3.0, 3.0)]])
        inputs = EstimatorInput(rng.integers(0, 256, (1, 64, 64, 3)).astype(np.uint8), pose)
        (said, a), (expected, b) = compiled.step(inputs, a), plain.step(inputs, b)
        assert said.shape == (1, 10, 10, 4) and np.allclose(said, expected, atol=1e-3)
        assert all(np.allclose(x, y, atol=1e-3) for x, y in zip(a, b, strict=True))


def test_no_probability_of_a_graph_is_above_one(tmp_path):
    weights, logits = tmp_path / "logits.safetensors", torch.full((1, 10, 10, 4), 17.86892318725586)
    nothing = torch.nn.Linear(1, 1)
    save_weights(weights, nothing, {}, {})
    signature = Signature(("logits",), ("estimate",), 0.0)
    export_graph(weights, nothing, lambda x: [probabilities(x)], [logits], signature)
    (said,) = CompiledGraph(graph_path(weights), digest(graph_path(weights)), signature)([logits.numpy()])
    assert said[..., 0].max() == 1.0, "ONNX Runtime's sigmoid of this number is 1.0000001"


def test_what_learns_on_leaves_the_graph_of_its_old_weights():
    assert mujoban_estimator.load().train().eval().compiled is None


def test_a_classifier_that_learns_on_leaves_the_graph_of_its_old_weights():
    assert mujoban_estimator.load_termination().train().eval().compiled is None
