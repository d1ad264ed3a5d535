"""Methods that go on from each other."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from mujoban_core.files import digest
from mujoban_planner import stages
from mujoban_planner.push_actor import PlayConfig
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_planner.push_run import training_record
from mujoban_planner.stages import StagesConfig, train_stages
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence, Trainer
from mujoban_rl.run_directory import RunError
from mujoban_rl.weights import save_weights

PLAY = PlayConfig(environments=8, steps=4)
CONFIG = StagesConfig(("ppo=1", "mpo-pushes=3"), cpu_seconds=8e9, channels=8, blocks=1, seed=3)
OFTEN = Cadence(publish_updates=1, save_seconds=math.inf)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Make methods tiny, and note what each was told."""
    told: list[Any] = []

    def tiny(kind: Any, make: Any, **size: Any) -> Any:
        def method(settings: Any, place: Any) -> Trainer[Any]:
            told.append(settings)
            trainer = make(kind(**settings._asdict(), play=PLAY, updates=3, **size), *place)
            trainer.learner.evaluate = dict
            return trainer

        return method

    ppo = tiny(PushPPOConfig, push_ppo, minibatch=32)
    mpo = tiny(PushMPOConfig, push_mpo, batch_size=32, first_steps=64, replay_steps=40, n_step=3)
    monkeypatch.setattr(stages, "METHODS", {"ppo": ppo, "mpo-pushes": mpo})
    torch.set_num_threads(1)
    return told


def test_each_stage_begins_with_the_planner_of_the_one_before(tmp_path: Path, started: list[Any]) -> None:
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    first, second = tmp_path / "1_ppo" / "planner.safetensors", tmp_path / "2_mpo-pushes" / "planner.safetensors"
    assert [s.init for s in started] == [None, str(first)]
    assert [s.cpu_seconds for s in started] == [2e9, 6e9]
    assert [s.seed for s in started] == [6, 7], "levels of its own, which no other seed's run has"
    record = json.loads((tmp_path / "planner.json").read_text())
    assert digest(tmp_path / "planner.safetensors") == digest(second)
    assert record["init"] == digest(first) and record["method"] == "ppo over pushes then mpo over pushes"
    assert [stage["digest"] for stage in record["stages"]] == [digest(first), digest(second)]
    for cost in ("samples", "updates", "cpu_seconds"):
        assert record[cost] == sum(stage[cost] for stage in record["stages"]) > max(s[cost] for s in record["stages"])


def test_weights_that_a_solver_has_taught_are_not_recorded_as_without_one(tmp_path: Path) -> None:
    network = NetworkConfig(channels=8, blocks=1).build()
    taught = tmp_path / "taught.safetensors"
    save_weights(taught, network, network.config, {"data": "solver demonstrations"})
    config = PushPPOConfig(channels=8, blocks=1, init=str(taught))
    assert training_record("ppo over pushes", config)["data"].startswith("solver demonstrations; then own play of")


def test_a_run_goes_on_with_the_stage_that_was_stopped(tmp_path: Path, started: list[Any]) -> None:
    assert not train_stages(CONFIG, tmp_path, OFTEN, ActorOptions(), seconds=0.0)
    assert len(started) == 1 and not (tmp_path / "planner.safetensors").exists()
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    first = digest(tmp_path / "1_ppo" / "planner.safetensors")
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    assert digest(tmp_path / "1_ppo" / "planner.safetensors") == first
    with pytest.raises(RunError):
        train_stages(StagesConfig(("ppo=1",)), tmp_path, OFTEN, ActorOptions())


@pytest.mark.parametrize("text", ["ppo", "ppo=0", "ppo=nan", "dqn=1", "=1"])
def test_bad_stages_are_named(text: str) -> None:
    with pytest.raises(ValueError, match=r"--stages .*: expected METHOD=SHARE with a method among"):
        StagesConfig((text,))
