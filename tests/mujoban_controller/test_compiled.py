import copy
import shutil

import numpy as np
import pytest
import torch

import mujoban_controller
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.export import export
from mujoban_core.interfaces import ControllerInput
from mujoban_rl.compiled import graph_path
from mujoban_rl.testing import robot_ticks
from mujoban_rl.weights import WeightsError, save_weights


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Weights of a small policy of the ant, which reads heading and place from frames, with their graph."""
    torch.manual_seed(0)
    policy = VisuomotorController("ant", channels=(8, 8), features=16, hidden=8, place=True, way=True)
    weights = tmp_path_factory.mktemp("exported") / "controller.safetensors"
    save_weights(weights, policy, policy.config, {})
    export(weights)
    return weights


@pytest.fixture
def exported(original, tmp_path):
    """A copy of the weights with their graph, to be changed."""
    shutil.copytree(original.parent, tmp_path / "copy")
    return tmp_path / "copy" / original.name


def test_the_policy_that_ships_drives_by_its_graph_as_in_pytorch():
    compiled = mujoban_controller.load()
    plain = mujoban_controller.load(compiled=False)
    assert compiled.compiled is not None and plain.compiled is None
    a, b = compiled.initial_memory(1), plain.initial_memory(1)
    for inputs in robot_ticks(ControllerInput, 30, plain.proprio_size, np.random.default_rng(0)):
        (torque, a), (expected, b) = compiled.step(inputs, a), plain.step(inputs, b)
        assert np.allclose(torque, expected, atol=1e-3)
        assert all(np.allclose(x, y, atol=1e-3) for x, y in zip(a, b, strict=True))


def test_a_body_that_does_not_feel_its_heading_has_a_graph_too(exported):
    compiled, plain = mujoban_controller.load(exported), mujoban_controller.load(exported, compiled=False)
    assert compiled.compiled is not None
    a, b = compiled.initial_memory(1), plain.initial_memory(1)
    for inputs in robot_ticks(ControllerInput, 10, plain.proprio_size, np.random.default_rng(1)):
        (torque, a), (expected, b) = compiled.step(inputs, a), plain.step(inputs, b)
        assert np.allclose(torque, expected, atol=1e-3)


def test_a_policy_that_learns_on_leaves_the_graph_of_its_old_weights(exported):
    policy = mujoban_controller.load(exported)
    assert copy.deepcopy(policy).compiled is not None
    assert policy.train().eval().compiled is None


def test_a_graph_of_other_weights_is_refused_or_not_used(exported):
    policy = mujoban_controller.load(exported, compiled=False)
    with torch.no_grad():
        policy.mean.weight.normal_()
    save_weights(exported, policy, policy.config, {})
    with pytest.warns(UserWarning, match=r"controller\.onnx: a graph of other weights .*bringup\.export"):
        assert mujoban_controller.load(exported).compiled is None
    graph_path(exported).write_bytes(b"no graph")
    save_weights(exported, policy, policy.config, {"graph": "0" * 64})
    with pytest.raises(WeightsError, match=r"controller\.onnx: damaged .*bringup\.export"):
        mujoban_controller.load(exported)
