import errno
import json
import math
import signal
import subprocess
import sys
from dataclasses import dataclass, field

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from mujoban_rl import run_directory
from mujoban_rl.limits import NaNGuard, TimeLimit
from mujoban_rl.run_directory import RunDirectory, RunError, copy_light
from mujoban_rl.training_log import TrainingLog
from mujoban_rl.weights import WeightsError, load_weights, record_path, save_weights


class Net(nn.Module):
    def __init__(self, width: int = 4) -> None:
        super().__init__()
        self.layer = nn.Linear(width, 2)


def _fit(net, adam, steps):
    for i in range(steps):
        adam.zero_grad()
        net.layer(torch.full((3, 4), float(i % 3))).square().sum().backward()
        adam.step()


def _make():
    torch.manual_seed(0)
    net = Net()
    return net, torch.optim.AdamW(net.parameters(), 1e-2)


def test_resumed_training_equals_uninterrupted_training(tmp_path):
    net, adam = _make()
    _fit(net, adam, 3)
    RunDirectory(tmp_path, {"lr": 1}).save(3, modules={"net": net}, optimisers={"adam": adam}, extra={"k": [1]})
    again, adam2 = _make()
    snapshot = RunDirectory(tmp_path, {"lr": 1}).load(modules={"net": again}, optimisers={"adam": adam2})
    assert snapshot is not None and (snapshot.step, snapshot.extra) == (3, {"k": [1]})
    _fit(net, adam, 3)
    _fit(again, adam2, 3)
    assert torch.equal(net.layer.weight, again.layer.weight)


@dataclass(frozen=True)
class _Part:
    rate: float = 0.5
    depth: int = 2


@dataclass(frozen=True)
class _Config:
    steps: int
    part: _Part = field(default_factory=_Part)
    horizon: float = 9.0


def test_a_run_from_before_an_option_came_goes_on_while_that_is_at_its_default(tmp_path):
    RunDirectory(tmp_path, {"steps": 3, "part": {"rate": 0.1}})
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    RunDirectory(tmp_path, _Config(3, _Part(rate=0.1)))
    same = _Part(0.1)
    for other in (_Config(3, same, horizon=8.0), _Config(3, _Part(0.1, depth=3)), _Config(3), _Config(4, same)):
        with pytest.raises(RunError, match="another configuration"):
            RunDirectory(tmp_path, other)


def test_what_stands_beside_the_options_must_not_change_either(tmp_path):
    RunDirectory(tmp_path, {"steps": 3, "method": "MPO"})
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    assert RunDirectory(tmp_path, _Config(3), beside={"method": "MPO"}).config["method"] == "MPO"
    with pytest.raises(RunError, match="method: 'MPO' there, 'PPO' now"):
        RunDirectory(tmp_path, _Config(3), beside={"method": "PPO"})


def test_a_run_that_failed_before_its_first_line_leaves_the_directory_to_another(tmp_path):
    with TrainingLog(RunDirectory(tmp_path, {"world": "refrence"})):
        pass
    assert RunDirectory(tmp_path, {"world": "reference"}).config == {"world": "reference"}


def test_what_was_not_noted_yet_when_a_run_began_is_taken_at_its_word(tmp_path):
    RunDirectory(tmp_path, {"steps": 3})
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    assert RunDirectory(tmp_path, _Config(3), beside={"method": "MPO"}).config["method"] == "MPO"


def test_a_number_that_is_not_finite_is_text_in_a_configuration_so_that_weights_can_have_it_in_their_record(tmp_path):
    directory = RunDirectory(tmp_path, _Config(3, horizon=math.inf))
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    net = Net()
    save_weights(tmp_path / "net.safetensors", net, {}, {"training": directory.config})
    assert json.loads(record_path(tmp_path / "net.safetensors").read_text())["training"]["horizon"] == "Infinity"
    (tmp_path / "config.json").write_text(json.dumps({"steps": 3, "part": {}, "horizon": math.inf}))
    RunDirectory(tmp_path, _Config(3, horizon=math.inf))
    with pytest.raises(RunError, match=r"horizon: 'Infinity' there, 9\.0 now"):
        RunDirectory(tmp_path, _Config(3))


@pytest.mark.parametrize("part", ["safetensors", "json"])
def test_a_checkpoint_that_finds_the_disk_full_leaves_the_one_before_it(tmp_path, monkeypatch, part):
    net, adam = _make()
    run = RunDirectory(tmp_path, {})
    run.save(1, modules={"net": net}, optimisers={"adam": adam})
    before = sorted(file.name for file in tmp_path.iterdir())

    def full(*_):
        if part == "safetensors":
            raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")
        raise OSError(errno.ENOSPC, "No space left on device", "checkpoint-0000000002.json")

    monkeypatch.setattr(run_directory, "save_file" if part == "safetensors" else "write_atomically", full)
    with pytest.raises(OSError, match=rf"No space left on device: .*checkpoint-0000000002\.{part}"):
        run.save(2, modules={"net": net}, optimisers={"adam": adam})
    assert sorted(file.name for file in tmp_path.iterdir()) == before
    snapshot = run.load(modules={"net": net}, optimisers={"adam": adam})
    assert snapshot is not None and snapshot.step == 1


_KILLED = """
import os, signal, sys, torch
from mujoban_rl import run_directory

def kill(tensors, path):
    path.with_name(".tmpAbC").write_bytes(b"half")  # as the library does, which renames it at the end
    os.kill(os.getpid(), signal.SIGKILL)

run_directory.save_file = kill
run_directory.RunDirectory(sys.argv[1], {}).save(1, modules={"net": torch.nn.Linear(2, 2)})
"""


def test_what_a_killed_process_had_written_of_a_checkpoint_does_not_stay_on_the_disk(tmp_path):
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert list(tmp_path.rglob(".tmp*"))
    RunDirectory(tmp_path, {}).save(2, modules={"net": nn.Linear(2, 2)})
    names = ["checkpoint-0000000002.json", "checkpoint-0000000002.safetensors", "config.json"]
    assert sorted(file.name for file in tmp_path.iterdir()) == names


def test_moments_come_back_in_the_layout_of_their_parameters_which_fused_optimisers_rely_on(tmp_path):
    def make():
        torch.manual_seed(0)
        net = nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
        return net, torch.optim.AdamW(net.parameters(), 1e-2, fused=True)

    def fit(net, adam):
        adam.zero_grad()
        net(torch.arange(75.0).view(1, 3, 5, 5).sin()).square().sum().backward()
        adam.step()

    net, adam = make()
    fit(net, adam)
    RunDirectory(tmp_path, {}).save(1, modules={"net": net}, optimisers={"adam": adam})
    again, adam2 = make()
    RunDirectory(tmp_path, {}).load(modules={"net": again}, optimisers={"adam": adam2})
    fit(net, adam)
    fit(again, adam2)
    assert torch.equal(net.weight, again.weight)


@pytest.mark.parametrize(("half", "content"), [("safetensors", b"broken"), ("json", b"\xff\xfe"), ("json", b"[]")])
def test_damaged_newest_checkpoint_falls_back_to_the_one_before(tmp_path, half, content):
    net, _adam = _make()
    run = RunDirectory(tmp_path, {})
    run.save(1, modules={"net": net})
    run.save(2, modules={"net": net}).with_suffix(f".{half}").write_bytes(content)
    snapshot = run.load(modules={"net": Net()})
    assert snapshot is not None and snapshot.step == 1
    (tmp_path / "checkpoint-0000000001.json").write_bytes(b"[]")
    with pytest.raises(RunError, match="none of 2 checkpoints"):
        run.load(modules={"net": Net()})


def test_a_run_that_was_killed_in_its_first_checkpoint_begins_anew(tmp_path):
    net, _ = _make()
    run = RunDirectory(tmp_path, {})
    killed = run.save(1, modules={"net": net})
    killed.with_suffix(".json").unlink()
    assert run.load(modules={"net": Net()}) is None
    run.save(2, modules={"net": net})
    assert not killed.exists()


def test_only_the_last_checkpoints_are_kept_and_nan_is_never_written(tmp_path):
    net, _ = _make()
    run = RunDirectory(tmp_path, {}, keep=2)
    for step in range(4):
        run.save(step, modules={"net": net})
    assert sorted(p.name for p in tmp_path.glob("*.safetensors")) == [
        f"checkpoint-{i:010d}.safetensors" for i in (2, 3)
    ]
    net.layer.bias.data[0] = float("nan")
    with pytest.raises(WeightsError, match=r"layer\.bias"):
        run.save(4, modules={"net": net})
    assert not (tmp_path / "checkpoint-0000000004.safetensors").exists()


def test_a_light_copy_halves_matrices_and_keeps_counts_as_they_are(tmp_path):
    nets = [Net(), Net()]
    for net, count in zip(nets, (1e6, 0.0), strict=True):
        net.register_buffer("count", torch.tensor(count))
    RunDirectory(tmp_path / "run", {}).save(3, modules={"net": nets[0]}, extra={"a": 1, "b": 2})
    copy = copy_light(tmp_path / "run", tmp_path / "copy", ["a"])
    snapshot = RunDirectory(tmp_path / "copy", {}).load(modules={"net": nets[1]})
    assert copy is not None and snapshot is not None and snapshot.light and snapshot.extra == {"a": 1}
    assert load_file(copy)["module/net/layer.weight"].dtype == torch.float16
    assert nets[1].count == 1e6
    torch.testing.assert_close(nets[1].layer.weight, nets[0].layer.weight, rtol=1e-3, atol=1e-6)


def test_a_light_copy_keeps_parts_of_parts(tmp_path):
    RunDirectory(tmp_path / "run", {}).save(
        3, modules={}, extra={"learner": {"best": {"score": 1.0}, "own": {}}, "source": {}},
        tensors={"learner.best.w": torch.ones(2), "learner.own.w": torch.ones(1)},
    )  # fmt: skip
    copy_light(tmp_path / "run", tmp_path / "copy", ["learner.best", "learner.none", "due"])
    snapshot = RunDirectory(tmp_path / "copy", {}).load(modules={})
    assert snapshot is not None and snapshot.extra == {"learner": {"best": {"score": 1.0}}}
    assert list(snapshot.tensors) == ["learner.best.w"]


def test_run_directory_refuses_another_configuration_once_something_was_done(tmp_path):
    RunDirectory(tmp_path, {"lr": 0})
    RunDirectory(tmp_path, {"lr": 1}).save(0, modules={})
    with pytest.raises(RunError, match="lr: 1 there, 2 now"):
        RunDirectory(tmp_path, {"lr": 2})
    RunDirectory(tmp_path, {"lr": 1})


def test_a_directory_of_another_kind_of_run_is_refused_by_name(tmp_path):
    old = RunDirectory(tmp_path / "old", {})
    old.save(3, modules={"learner.net": nn.Linear(2, 2)}, extra={"seconds": 1.0})
    with pytest.raises(RunError, match=r"old: its checkpoint at step 3 .*no entry 'adam'.*expected"):
        optimiser = torch.optim.Adam(nn.Linear(2, 2).parameters())
        old.load(modules={"learner.net": nn.Linear(2, 2)}, optimisers={"adam": optimiser})
    with pytest.raises(RunError, match=r"old: its checkpoint at step 3 .*expected"):
        old.load(modules={"learner.net": nn.Linear(3, 2)})
    (tmp_path / "old" / "config.json").write_text("[1]")
    with pytest.raises(RunError, match=r"config\.json: no JSON object, expected"):
        RunDirectory(tmp_path / "old", {})
    (tmp_path / "old" / "config.json").unlink()
    with pytest.raises(RunError, match=r"old: has checkpoints but no config\.json, expected"):
        RunDirectory(tmp_path / "old", {})


def test_weights_round_trip_and_name_what_is_wrong(tmp_path):
    net, _ = _make()
    path = tmp_path / "net.safetensors"
    save_weights(path, net, {"width": 4}, {"steps": 7})
    assert torch.equal(load_weights(Net, path).layer.weight, net.layer.weight)
    record = json.loads(record_path(path).read_text())
    assert record["steps"] == 7

    record_path(path).write_text(json.dumps(record | {"config": {"width": 5}}))
    with pytest.raises(WeightsError, match=r"layer\.weight has shape \(2, 4\), expected \(2, 5\)"):
        load_weights(Net, path)
    record_path(path).write_text(json.dumps(record | {"config": {"depth": 5}}))
    with pytest.raises(WeightsError, match="configuration does not fit Net"):
        load_weights(Net, path)
    record_path(path).write_text(json.dumps(record | {"class": "Other"}))
    with pytest.raises(WeightsError, match="holds weights of Other"):
        load_weights(Net, path)
    record_path(path).write_text(json.dumps(record))
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(WeightsError, match="damaged"):
        load_weights(Net, path)
    with pytest.raises(WeightsError, match="no such weights file"):
        load_weights(Net, tmp_path / "none.safetensors")


def test_a_step_that_is_never_finite_ends_training_though_another_of_each_update_is():
    guard = NaNGuard(patience=2)
    for _ in range(2):
        assert guard.accept(1.0, part="critic") and not guard.accept(math.nan, part="policy")
    assert guard.accept(1.0, part="critic")
    with pytest.raises(FloatingPointError, match="3 non-finite steps in a row"):
        guard.accept(math.nan, part="policy")


def test_nan_guard_refuses_and_gives_up():
    guard = NaNGuard(patience=2)
    assert guard.accept(torch.tensor(1.0), 2.0)
    assert not guard.accept(torch.tensor(float("nan")))
    assert not guard.accept(float("inf"))
    with pytest.raises(FloatingPointError):
        guard.accept(float("nan"))


def test_a_time_limit_ends_when_its_time_is_up():
    assert TimeLimit(0.0).reached and not TimeLimit(None).reached
