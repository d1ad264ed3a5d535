"""Methods that go on from each other."""

from __future__ import annotations

import json
import math
import os
import re
import signal
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mujoban_core.files import digest
from mujoban_core.grid import GRID_SIZE
from mujoban_core.signals import Interrupted
from mujoban_planner import load, stages, train
from mujoban_planner.expert_iteration import ExpertIterationConfig
from mujoban_planner.imitation import ImitationConfig
from mujoban_planner.push_actor import PlayConfig
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_planner.push_run import training_record
from mujoban_planner.reinforcement import MPOConfig
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

    def tiny(config: Any, make: Any) -> stages._Method:
        def method(config: Any, place: Any) -> Trainer[Any]:
            told.append(replace(config, init=place.init))
            trainer = make(told[-1], place.run, place.cadence, place.actors)
            trainer.learner.evaluate = dict
            return trainer

        return stages._Method(config, method)

    ppo = tiny(PushPPOConfig(play=PLAY, updates=3, minibatch=32), push_ppo)
    small = PushMPOConfig(play=PLAY, updates=3, batch_size=32, first_steps=64, replay_steps=40, n_step=3)
    monkeypatch.setattr(stages, "METHODS", {"ppo": ppo, "mpo-pushes": tiny(small, push_mpo)})
    torch.set_num_threads(1)
    return told


def changed(monkeypatch: pytest.MonkeyPatch, change: Callable[[Trainer[Any], Any], None]) -> None:
    """Change the trainer of every stage, of which the place is told as well."""

    def changing(method: stages._Method) -> stages._Method:
        def make(config: Any, place: Any) -> Trainer[Any]:
            trainer = method.trainer(config, place)
            change(trainer, place)
            return trainer

        return method._replace(trainer=make)

    monkeypatch.setattr(stages, "METHODS", {name: changing(method) for name, method in stages.METHODS.items()})


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
    def judged(trainer: Trainer[Any], place: Any) -> None:
        del trainer.learner.evaluate

    changed(monkeypatch, judged)
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

    def interrupted(trainer: Trainer[Any], place: Any) -> None:
        def judge() -> dict[str, float]:
            judged.append(place.run.name)
            if len(judged) == 1:
                os.kill(os.getpid(), signal.SIGTERM)
            return {}

        trainer.learner.evaluate = judge

    changed(monkeypatch, interrupted)
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
        config = replace(stages.METHODS[method].config, channels=8, blocks=1, cpu_seconds=1e9)
        return stages.METHODS[method].trainer(config, stages._Place(tmp_path, OFTEN, ActorOptions(), "cpu", None))

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


@pytest.mark.parametrize("method", sorted(stages.METHODS))
def test_a_run_does_not_go_on_with_other_weights_in_the_place_of_those_that_it_began_with(
    method: str, tmp_path: Path
) -> None:
    def make() -> Trainer[Any]:
        config = replace(stages.METHODS[method].config, **asdict(network), cpu_seconds=1e9)
        place = stages._Place(tmp_path / "run", OFTEN, ActorOptions(), "cpu", str(start))
        return stages.METHODS[method].trainer(config, place)

    start = small_planner(tmp_path / "start.safetensors")
    network = NetworkConfig.of(start)
    make().save()
    make()
    then = digest(start)
    torch.manual_seed(99)  # of no run
    now = digest(small_planner(start))
    with pytest.raises(RunError) as error:
        make()
    assert re.search(f"'start.safetensors', 'digest': '{then}'.* there, .*'{now}'.* now", str(error.value))
    assert len(str(error.value).splitlines()) == 1
    # Runs that began before this was noted are taken at their word.
    file = tmp_path / "run" / "config.json"
    noted = json.loads(file.read_text())
    del noted["init" if method == "mpo" else "begun_with"]
    file.write_text(json.dumps(noted))
    make()


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


OWN = replace(CONFIG, stages=("ppo=1 --epochs 2 --steps 2", "mpo-pushes=3 --learning-rate 2e-4 --no-time-outs-lost"))


def stored(run: Path, stage: str) -> dict[str, Any]:
    """Return the configuration that a stage of a run keeps."""
    return json.loads((run / stage / "config.json").read_text())


def test_options_in_the_text_of_a_stage_are_those_of_its_method_alone(tmp_path: Path, started: list[Any]) -> None:
    assert train_stages(CONFIG, tmp_path / "plain", OFTEN, ActorOptions())
    assert train_stages(OWN, tmp_path / "own", OFTEN, ActorOptions())
    plain, ppo = (stored(tmp_path / run, "1_ppo") for run in ("plain", "own"))
    assert ppo == plain | {"epochs": 2, "play": plain["play"] | {"steps": 2}} != plain
    plain, mpo = (stored(tmp_path / run, "2_mpo-pushes") for run in ("plain", "own"))
    begun = tmp_path / "own" / "1_ppo" / "planner.safetensors"
    init = {"init": str(begun), "begun_with": {"path": begun.name, "digest": digest(begun)}}
    assert mpo == plain | init | {"learning_rate": 2e-4, "time_outs_lost": False}


def test_a_run_with_other_options_of_a_stage_is_another(tmp_path: Path, started: list[Any]) -> None:
    assert not train_stages(OWN, tmp_path, OFTEN, ActorOptions(), seconds=0.0)
    other = replace(OWN, stages=("ppo=1 --epochs 3 --steps 2", *OWN.stages[1:]))
    with pytest.raises(RunError, match=r"stages: .*--epochs 2 .* there, .*--epochs 3 .* now"):
        train_stages(other, tmp_path, OFTEN, ActorOptions())
    assert train_stages(OWN, tmp_path, OFTEN, ActorOptions())


def test_a_stage_without_options_has_those_that_it_always_had() -> None:
    whole = {"channels": 48, "blocks": 6, "cpu_seconds": 21_600 / 5}
    expected = [
        ExpertIterationConfig(**whole, seed=20), ImitationConfig(**whole, seed=21, horizon_samples=1e12),
        MPOConfig(**whole, seed=22), PushMPOConfig(**whole, seed=23), PushPPOConfig(**whole, seed=24),
    ]  # fmt: skip
    texts = tuple(f"{name}=0.2" for name in sorted(stages.METHODS))
    assert [own for _, own in StagesConfig(stages=texts, cpu_seconds=21_600, seed=4).parsed] == expected


def test_options_of_settings_within_a_methods_are_named_without_a_prefix() -> None:
    ((_, own),) = StagesConfig(stages=("expert-iteration=1 --mined 0.25 --led=1 --thoughts 1 2",)).parsed
    assert (own.search.mined, own.search.led, own.thoughts) == (0.25, 1.0, (1, 2))
    ((_, own),) = StagesConfig(stages=("imitation=1 --horizon-samples 5e6",)).parsed
    assert own.horizon_samples == 5e6


LISTED = "expected what `train ppo --help` lists as config options"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ppo=1 --lerning-rate 3", "unrecognized options: --lerning-rate, 3, expected --learning-rate FLOAT"),
        ("ppo=1 --bogus 3", f"unrecognized options: --bogus, 3, {LISTED}"),
        ("ppo=1 --help", f"unrecognized options: --help, {LISTED}"),
        ("ppo=1 --tyro-print-completion bash", f"unrecognized options: --tyro-print-completion, {LISTED}"),
        ("ppo=1 --epochs 2.5", "--epochs: invalid literal for int() with base 10: '2.5', expected --epochs INT"),
        ("ppo=1 --epochs", "--epochs has no value, expected one"),
        ("ppo=1 --epochs 0", "epochs is 0: expected at least 1"),
        ("ppo=1 --updates nan", "budget of nan updates: expected a positive number"),
        ("ppo=1 --seed=3", "--seed is the whole run's, expected outside of a stage's text"),
        ("ppo=1 --no-judge", "--no-judge is the whole run's, expected outside of a stage's text"),
        ("mpo=1 --init x", "--init is the whole run's, expected outside of a stage's text"),
        ("mpo=1 --bag_share 1", "--bag_share is of bags, expected none, as no stage reads any"),
        ("ppo=1 --epochs '2", "No closing quotation, expected words as a shell splits them"),
    ],
)
def test_a_bad_option_of_a_stage_is_named_before_anything_is_written(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError) as error:
        StagesConfig(stages=("imitation=1", text))
    assert str(error.value) == f"--stages {text}: {said}"
    with pytest.raises(ValueError) as error:
        train.main(["stages", "--run", str(tmp_path / "run"), "--stages", "imitation=1", text])
    assert str(error.value) == f"--stages {text}: {said}"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["ppo", "mpo-pushes"])
def test_a_later_stage_that_needs_propagation_is_refused_without_it(method: str) -> None:
    with pytest.raises(ValueError, match=f"^--stages {method}=1: propagation is False: expected True, by which"):
        StagesConfig(stages=("imitation=1", f"{method}=1"), propagation=False)
    assert StagesConfig(stages=("imitation=1", "mpo=1"), propagation=False).parsed


@pytest.mark.parametrize(
    ("method", "last"), [("mpo", 99), ("imitation", 599), ("expert-iteration", 3910), ("ppo", 3910)]
)
def test_a_later_stage_whose_own_seed_has_no_levels_is_refused(method: str, last: int) -> None:
    stages = ("ppo=1", f"{method}=1")
    with pytest.raises(ValueError, match=rf"^--stages {method}=1: seed is \d+: expected 0 to {last}, as there are no"):
        StagesConfig(stages=stages, seed=(last + 1) // 2)
    assert StagesConfig(stages=stages, seed=(last - 1) // 2).parsed


def test_weights_that_there_are_none_of_have_no_share_in_the_first_stage_alone(tmp_path: Path) -> None:
    half = "imitation=1 --init-share 0.5"
    with pytest.raises(ValueError, match=r"^init_share is 0\.5: expected 0, or an --init whose share it is$"):
        train.main(["stages", "--run", str(tmp_path / "run"), "--stages", half, "ppo=1"])
    assert not (tmp_path / "run").exists()
    assert StagesConfig(stages=(half,), init="weights.safetensors").parsed[0][1].init_share == 0.5
    assert StagesConfig(stages=("ppo=1", half)).parsed[1][1].init_share == 0.5


def test_all_options_of_the_whole_run_are_refused_in_a_stage_and_none_of_its_methods() -> None:
    whole = {option.name for kind in (train.Stages, StagesConfig, ActorOptions) for option in fields(kind)}
    for name in whole - {"config"}:
        with pytest.raises(ValueError, match=f"--{name} is the whole run's"):
            StagesConfig(stages=(f"ppo=1 --{name} 1",))
    shared = {option.name for option in fields(NetworkConfig)} | {"init", "seed", "cpu_seconds"}
    for method in stages.METHODS.values():
        assert stages._WHOLE & {option.name for option in fields(method.config)} <= shared
