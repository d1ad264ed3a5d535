"""Weights and records that nobody should load: each is one error that names the file, before memory is taken."""

import json
import os
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save
from torch import nn

from mujoban_core.files import digest
from mujoban_estimator.estimator import StateEstimator
from mujoban_rl import weights as w
from mujoban_rl.weights import WeightsError, load_weights, record_path, save_weights, usable_device


class Small(nn.Module):
    def __init__(self, size: int = 4, layers: int = 2):
        super().__init__()
        self.layers = nn.Sequential(*(nn.Linear(size, size) for _ in range(layers)))


@pytest.fixture
def small(tmp_path):
    save_weights(tmp_path / "small.safetensors", Small(), {"size": 4, "layers": 2}, {})
    return tmp_path / "small.safetensors"


def change(path, **fields):
    record = json.loads(record_path(path).read_text()) | fields
    record_path(path).write_text(json.dumps(record))


@pytest.mark.parametrize(
    "config",
    [
        {"size": -4}, {"size": 10**12}, {"size": 60_000, "layers": 60_000}, {"size": "four"}, {"size": None},
        {"size": 4.5}, {"size": [4]}, {"size": {"of": 4}}, {"size": float("nan")}, {"size": 0}, {"size": 8},
        {"layers": 10**9}, {"layers": -1}, {"layers": 3}, {"width": 4}, {"size": True},
    ],
)  # fmt: skip
def test_an_impossible_configuration_is_one_error(small, config):
    change(small, config=config)
    with pytest.raises(WeightsError, match=r"small\.(json|safetensors): ") as raised:
        load_weights(Small, small)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("config", [{"channels": -1}, {"blocks": 10**6}, {"stem": "16"}, {"update_every": 0}])
def test_so_it_is_for_modules_that_ship(tmp_path, config):
    save_weights(tmp_path / "e.safetensors", StateEstimator(), {}, {})
    change(tmp_path / "e.safetensors", config=config)
    with pytest.raises(WeightsError, match=r"e\.(json|safetensors): "):
        load_weights(StateEstimator, tmp_path / "e.safetensors")


@pytest.mark.parametrize(
    "record", ["", "[" * 100_000, "[]", "\xff", '{"class": 1, "config": {}, "digest": ""}',
               '{"class": "Small", "config": [], "digest": ""}', '{"class": "Small", "config": {}, "digest": 5}'],
)  # fmt: skip
def test_a_record_that_is_none_is_named(small, record):
    record_path(small).write_text(record, encoding="latin-1")
    with pytest.raises(WeightsError, match=r"small\.json: "):
        load_weights(Small, small)


def test_what_is_too_large_is_not_read(small, monkeypatch):
    monkeypatch.setattr(w, "WEIGHTS_LIMIT", 100)
    with pytest.raises(WeightsError, match=r"small\.safetensors: has \d+ bytes, expected at most 100"):
        load_weights(Small, small)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_no_numbers_are_refused(small, value):
    module = Small()
    with torch.no_grad():
        module.layers[1].weight[2, 3] = value
    data = save({name: tensor.contiguous() for name, tensor in module.state_dict().items()})
    small.write_bytes(data)
    change(small, digest=digest(small))
    with pytest.raises(WeightsError, match=r"layers\.1\.weight is not finite"):
        load_weights(Small, small)


def test_no_flipped_bit_is_loaded(small, tmp_path):
    rng = np.random.default_rng(0)
    for _ in range(100):
        copy = shutil.copy(small, tmp_path / "copy.safetensors")
        shutil.copy(record_path(small), tmp_path / "copy.json")
        data = bytearray(small.read_bytes())
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        (tmp_path / "copy.safetensors").write_bytes(data)
        with pytest.raises(WeightsError, match=r"copy\.safetensors"):
            load_weights(Small, copy)


@pytest.mark.parametrize("device", ["meta", "cuda:99", "gpu", "", "mps", "cpu:x"])
def test_a_device_that_is_not_there_is_named(device):
    with pytest.raises(WeightsError, match=f"device '{device}'"):
        usable_device(device)
    assert usable_device("cpu").type == "cpu"


def test_weights_that_are_missing_are_named_and_not_their_record(tmp_path):
    with pytest.raises(WeightsError, match=r"none\.safetensors: no such weights file; expected \.safetensors"):
        w.read_record(tmp_path / "none.safetensors")


def test_a_record_names_the_commit_of_this_code_and_of_no_other(tmp_path, monkeypatch):
    environment = {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@b"}
    environment |= {"GIT_COMMITTER_NAME": "a", "GIT_COMMITTER_EMAIL": "a@b", **os.environ}
    file = tmp_path / "weights.py"
    file.touch()

    def git(*command):
        return subprocess.run(["git", *command], cwd=tmp_path, env=environment, check=True, capture_output=True)

    monkeypatch.setattr(w, "__file__", str(file))
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "another project")
    assert w.provenance()["commit"] is None
    git("add", "weights.py")
    git("commit", "-q", "-m", "this one")
    assert w.provenance()["commit"] == git("rev-parse", "HEAD").stdout.decode().strip()


def test_a_recorded_command_is_read_back_word_by_word(monkeypatch):
    words = ["train.py", "--stages", "ppo=1 --epochs 2", "--run", "it's here"]
    monkeypatch.setattr(sys, "argv", words)
    assert shlex.split(w.provenance()["command"])[-4:] == words[1:]
