"""What is copied of a run, to go on with it elsewhere."""

import json

import pytest
import torch
from torch import nn

from bringup.carry import carry, main
from bringup.pipeline import Pipeline
from mujoban_core.files import InUseError
from mujoban_rl.run_directory import RunDirectory


@pytest.fixture
def run(tmp_path):
    """A run with a training that is done, one under way and recorded bags."""
    folder = tmp_path / "run"
    (folder / "bags_first" / "part").mkdir(parents=True)
    (folder / "bags_first" / "part" / "episodes.json").write_text("{}")
    for name in ("done", "under_way"):
        net = nn.Linear(3, 1)
        adam = torch.optim.Adam(net.parameters())
        net(torch.ones(1, 3)).sum().backward()
        adam.step()
        extra = {"progress": {"samples": 7}, "metrics": {}, "skipped": 0, "source": {"place": 3}}
        replay = {"source.replay": torch.zeros(100_000)}
        directory = RunDirectory(folder / name, {})
        directory.save(7, modules={"net": net}, optimisers={"adam": adam}, extra=extra, tensors=replay)
        (folder / name / "net.safetensors").write_bytes(b"weights")
        (folder / name / "events.out.tfevents.1").touch()
    entries = {
        "done": {"command": ["-m", "train"], "done": True},
        "bags_first": {"command": ["-m", "bringup.record"], "done": True},
        "under_way": {"command": ["-m", "train"]},
    }
    (folder / "pipeline.json").write_text(json.dumps(entries))
    return folder


def test_weights_and_light_checkpoints_are_copied_but_neither_bags_nor_what_was_gathered(run, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["--run", str(run), "--out", str(out)]) == 0
    found = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    checkpoint = "under_way/checkpoint-0000000007"
    assert found == {
        "pipeline.json", "done/config.json", "done/net.safetensors", "under_way/config.json",
        "under_way/net.safetensors", f"{checkpoint}.json", f"{checkpoint}.safetensors",
    }  # fmt: skip
    assert (out / f"{checkpoint}.safetensors").stat().st_size < 1000
    assert "0.0 MB" in capsys.readouterr().out


def test_a_run_whose_stages_run_is_not_copied(run, tmp_path):
    with Pipeline.read(run).alone(), pytest.raises(InUseError, match="another process is at work here"):
        carry(run, tmp_path / "out")


def test_what_is_no_run_and_a_copy_over_another_are_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"no pipeline\.json, expected the directory of a run"):
        carry(tmp_path, tmp_path / "out")
    with pytest.raises(ValueError, match="exists, expected a directory to make"):
        carry(run, run)
