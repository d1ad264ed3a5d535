"""Methods that go on from each other."""

from __future__ import annotations

import json
import math
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from mujoban_core.files import digest
from mujoban_core.grid import GRID_SIZE
from mujoban_core.signals import Interrupted
from mujoban_planner import load, stages, train
from mujoban_planner.push_actor import PlayConfig
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_planner.push_run import training_record
from mujoban_planner.stages import StagesConfig, train_stages
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence, Trainer
from mujoban_rl.run_directory import RunError
from mujoban_rl.weights import WeightsError, read_record, save_weights

PLAY = PlayConfig(environments=8, steps=4)
CONFIG = StagesConfig(stages=("ppo=1", "mpo-pushes=3"), cpu_seconds=8e9, channels=8, blocks=1, seed=3)
OFTEN = Cadence(publish_updates=1, save_seconds=math.inf)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Make methods tiny, and note what each was told."""
    told: list[Any] = []

    def tiny(kind: Any, make: Any, **size: Any) -> Any:
        def method(settings: Any, place: Any) -> Trainer[Any]:
            told.append(settings)
            config = kind(**settings.options, play=PLAY, updates=3, **size)
            trainer = make(config, place.run, place.cadence, place.actors)
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


def test_a_stage_that_only_makes_its_planner_worse_leaves_it_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: list[Any]
) -> None:
    def judged(method: Any) -> Any:
        def make(settings: Any, place: Any) -> Trainer[Any]:
            trainer = method(settings, place)
            del trainer.learner.evaluate
            return trainer

        return make

    monkeypatch.setattr(stages, "METHODS", {name: judged(method) for name, method in stages.METHODS.items()})
    rates = iter([0.5, 0.5, 0.2])  # the first stage's, what the second begins with, what that makes of it
    monkeypatch.setattr("mujoban_planner.product.success_rates", lambda planner: {"success_rate/5": next(rates)})
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    first = load(tmp_path / "1_ppo" / "planner.safetensors", compiled=False).state_dict()
    shipped = load(tmp_path / "planner.safetensors", compiled=False).state_dict()
    assert all(torch.equal(values, shipped[name]) for name, values in first.items())
    record = json.loads((tmp_path / "planner.json").read_text())
    assert record["validation"] == {"success_rate/5": 0.5} and record["evaluation"] == 0


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
        train_stages(StagesConfig(stages=("ppo=1",)), tmp_path, OFTEN, ActorOptions())


def test_a_stage_whose_last_evaluation_was_cut_short_is_judged_when_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: list[Any]
) -> None:
    judged: list[str] = []

    def interrupted(method: Any) -> Any:
        def make(settings: Any, place: Any) -> Trainer[Any]:
            trainer = method(settings, place)

            def judge() -> dict[str, float]:
                judged.append(place.run.name)
                if len(judged) == 1:
                    os.kill(os.getpid(), signal.SIGTERM)
                return {}

            trainer.learner.evaluate = judge
            return trainer

        return make

    monkeypatch.setattr(stages, "METHODS", {name: interrupted(method) for name, method in stages.METHODS.items()})
    with pytest.raises(Interrupted):
        train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())
    assert judged[:2] == ["1_ppo", "1_ppo"] and set(judged[2:]) == {"2_mpo-pushes"}


def small_planner(path: Path, *, blocks: int = 2) -> Path:
    """Write weights that say something else for every board."""
    network = NetworkConfig("thinking", channels=8, blocks=blocks, tied=1).build()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.1)
    save_weights(path, network, network.config, {"data": "a test"})
    return path


@pytest.mark.parametrize("method", sorted(stages.METHODS))
def test_every_method_exports_the_planner_that_solved_most_held_out_levels(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make() -> Trainer[Any]:
        settings = stages._Settings(NetworkConfig(channels=8, blocks=1), None, seed=0, cpu_seconds=1e9)
        return stages.METHODS[method](settings, stages._Place(tmp_path, OFTEN, ActorOptions(), "cpu"))

    rates = [{"success_rate/5": 0.5, "success_rate/4": 0.7}, {"success_rate/5": 0.4, "success_rate/4": 0.9}]
    found = iter(rates)
    monkeypatch.setattr("mujoban_planner.product.success_rates", lambda planner: next(found))
    trainer = make()
    for value in (1.0, 2.0):
        trainer.learner.product.encoder.weight.data.fill_(value)
        trainer.learner.evaluate()
    trainer.save()
    resumed = make()
    resumed.learner.export(resumed.directory, {})
    file = tmp_path / "planner.safetensors"
    # Imitation's lessons show estimates, of which levels that are seen whole tell nothing: the newest counts.
    value, *told = (2.0, None, None) if method == "imitation" else (1.0, rates[0], 0)
    assert float(load(file, compiled=False).encoder.weight.detach().max()) == value
    record = read_record(file)
    assert [record["validation"], record["evaluation"]] == told


@pytest.mark.parametrize("method", sorted(stages.METHODS))
def test_every_method_goes_on_with_a_planner_that_thinks(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mujoban_planner.validation._EPISODES", {1: 4})
    start = small_planner(tmp_path / "start.safetensors")
    where = ["--run", str(tmp_path / "run"), "--init", str(start), "--stages", f"{method}=1", "--seconds", "0"]
    network = ["--architecture", "thinking", "--channels", "8", "--blocks", "3", "--tied", "1"]
    assert train.main(["stages", *where, *network]) == 0
    product = tmp_path / "run" / f"1_{method}" / "planner.safetensors"
    before, after = load(start, compiled=False), load(product, compiled=False)
    assert type(after) is type(before) and after.config["blocks"] == 3
    states = torch.rand(4, GRID_SIZE, GRID_SIZE, 4)
    with torch.no_grad():
        said, says = before(states), after(states)
    for name in ("push", "push_dead", "plan", "q"):
        assert torch.allclose(getattr(said, name), getattr(says, name), atol=1e-4), name
    assert json.loads(product.with_suffix(".json").read_text())["data"].startswith("a test; then ")


def test_weights_that_do_not_fit_are_named_before_anything_is_written(tmp_path: Path) -> None:
    start = small_planner(tmp_path / "start.safetensors", blocks=4)
    config = StagesConfig("thinking", channels=8, blocks=3, tied=1, init=str(start))
    with pytest.raises(WeightsError, match=r"start.safetensors: a ThinkingPlanner .* expected .* with at most"):
        train_stages(config, tmp_path / "run", OFTEN, ActorOptions())
    assert not (tmp_path / "run").exists()


def what_is_told(method: str, made: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return all that the trainer of a method is made of, as the first of two stages with a quarter of the time."""
    told: list[Any] = []

    class Told(Exception):
        pass

    def note(*arguments: Any, **options: Any) -> None:
        told.extend([*arguments, *options.values()])
        raise Told

    monkeypatch.setattr(stages, made, note)
    config = StagesConfig(stages=(f"{method}=1", "ppo=3"), cpu_seconds=400.0)
    with pytest.raises(Told):
        train_stages(config, folder, Cadence(), ActorOptions("threads", 3), device="cuda")
    return told


MADE = {"imitation": "imitation", "mpo": "reinforcement", "expert-iteration": "expert_iteration"}


@pytest.mark.parametrize("method", sorted(MADE))
def test_methods_get_the_actors_the_device_and_their_share_of_the_cpu_seconds(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = what_is_told(method, MADE[method], tmp_path, monkeypatch)
    assert ActorOptions("threads", 3) in told and "cuda" in told and told[0].cpu_seconds == 100.0


def test_each_rollout_of_ppo_is_played_by_the_newest_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = what_is_told("ppo", "push_ppo", tmp_path, monkeypatch)
    assert Cadence(publish_updates=1) in told and told[0].cpu_seconds == 100.0


def test_a_run_from_before_there_were_other_networks_goes_on(tmp_path: Path, started: list[Any]) -> None:
    assert not train_stages(CONFIG, tmp_path, OFTEN, ActorOptions(), seconds=0.0)
    file = tmp_path / "config.json"
    known = ("stages", "cpu_seconds", "channels", "blocks", "seed")
    file.write_text(json.dumps({name: json.loads(file.read_text())[name] for name in known}))
    assert train_stages(CONFIG, tmp_path, OFTEN, ActorOptions())


@pytest.mark.parametrize("text", ["ppo", "ppo=0", "ppo=nan", "dqn=1", "=1"])
def test_bad_stages_are_named(text: str) -> None:
    with pytest.raises(ValueError, match=r"--stages .*: expected METHOD=SHARE with a method among"):
        StagesConfig(stages=(text,))
