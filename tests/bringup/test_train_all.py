"""What the stages of a run from nothing are told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import bringup.evaluate
import bringup.keep
import bringup.record
import mujoban_controller.train
import mujoban_estimator.train
import mujoban_planner.train
from bringup.options import WorldOptions
from bringup.pipeline import Pipeline
from bringup.train_all import PRODUCTS, WEIGHTS, Options, stages, train_all
from bringup.training_report import EVALUATIONS, write_report
from mujoban_core.program import read_options
from mujoban_planner.expert_iteration import ExpertIterationConfig
from mujoban_planner.growth import start_from
from mujoban_planner.seed_streams import LAST_SEED, stream_number
from mujoban_planner.training_levels import TrainingLevels
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.weights import save_weights
from mujoban_sokoban.generator import VALIDATION_SEEDS, seed_range


def commands(options: Options) -> dict[str, tuple[str, ...]]:
    return {stage.name: stage.command for stage in stages(options)}


def finished(folder: Path, planner: NetworkConfig | None = None, solved: float = 0.0, **training: Any) -> Path:
    """Make what a finished run leaves; stages look at names, and at the record of the planner."""
    for product in PRODUCTS.values():
        path = folder / product
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    network = (planner or ExpertIterationConfig().network).build()
    record = {"training": training, "metrics": {"success_rate/5": solved}}
    save_weights(folder / PRODUCTS["planner"], network, network.config, record)
    return folder


def test_a_run_begins_from_nothing(tmp_path: Path) -> None:
    for name, command in commands(Options(run=tmp_path)).items():
        begun = {option for option in ("--initial", "--init", "--start", "--critic") if option in command}
        # What a later stage begins with was made by an earlier one of the same run.
        assert all(command[command.index(option) + 1].startswith(str(tmp_path)) for option in begun), name
        assert "--initial" not in begun or name == "controller_mpo"


def test_a_stage_needs_all_whose_products_it_reads(tmp_path: Path) -> None:
    found = {stage.name: stage for stage in stages(Options(run=tmp_path))}
    read = 0
    for stage in found.values():
        before = {str(p) for need in stage.needs for p in found[need].products}
        own = {str(tmp_path / stage.name), *map(str, stage.products)}
        named = [x for x in stage.command if x.startswith(str(tmp_path)) and x not in own]
        assert all(any(x == y or x.startswith(f"{y}/") for y in before) for x in named), (stage.name, named)
        read += len(named)
    assert read > 15


def test_a_continued_run_takes_every_module_from_the_one_before(tmp_path: Path) -> None:
    before = finished(tmp_path / "before")
    found = commands(Options(run=tmp_path / "run", before=before))
    for name, option, product in (
        ("teacher", "--initial", "teacher"), ("teacher", "--critic", "critic"),
        ("controller_distil", "--initial", "controller"), ("planner", "--init", "planner"),
    ):  # fmt: skip
        assert found[name][found[name].index(option) + 1] == str(before / PRODUCTS[product])
    assert found["teacher"][found["teacher"].index("--mpo.steady") + 1] == "0.25"
    first = found["estimator_first"]
    assert first[first.index("--start") + 1] == str((before / PRODUCTS["estimator"]).parent)
    assert str(before / PRODUCTS["first"]) in first and str(before / PRODUCTS["second"]) in found["estimator_second"]


@pytest.mark.parametrize(
    ("device", "before", "expected"),
    [
        ("cpu", NetworkConfig("thinking", 64, 12, 6), NetworkConfig("thinking", 64, 12, 6)),
        ("cpu", NetworkConfig("residual", 32, 8), NetworkConfig("residual", 48, 8)),
        ("cpu", NetworkConfig("residual", 64, 4, judge=False), NetworkConfig("residual", 64, 6, judge=False)),
        ("cpu", NetworkConfig("recurrent", 16, depth=2), NetworkConfig("recurrent", 16, depth=2)),
        ("cuda", NetworkConfig("residual", 48, 6), NetworkConfig("thinking", 64, 12, 6)),
        ("cuda", NetworkConfig("thinking", 80, 9, 5), NetworkConfig("thinking", 80, 9, 5)),
    ],
)
def test_a_planner_goes_on_in_a_network_that_holds_the_one_before(
    tmp_path: Path, device: str, before: NetworkConfig, expected: NetworkConfig
) -> None:
    former = finished(tmp_path / "before", before, thoughts=[1, 4])
    found = commands(Options(run=tmp_path / "run", before=former, device=device, cores=4))
    programs = {"expert-iteration": mujoban_planner.train.ExpertIteration}
    options = read_options(programs, found["planner"][2:], "planner")
    network = options.config.build()
    assert network.config == expected.build().config
    start_from(network, former / PRODUCTS["planner"])
    taught = {"cuda": (1, 2, 1, 4), "cpu": (1, 4) if before.architecture == "thinking" else (1,)}
    assert options.config.thoughts == taught[device]


def test_a_planner_of_the_same_size_needs_no_options(tmp_path: Path) -> None:
    """So the commands of runs that were begun before stay what they were."""
    begun = commands(Options(run=tmp_path / "run", before=finished(tmp_path / "before")))
    assert not {"--architecture", "--channels", "--blocks", "--thoughts"} & {*begun["planner"]}


@pytest.mark.parametrize(
    ("solved", "training", "share"),
    [(0.94, {}, 0.0), (0.95, {}, 0.5), (0.99, {"init_share": 0.5}, 0.667), (0.99, {"init_share": 0.667}, 0.75)],
)
def test_a_planner_that_loses_few_levels_ends_as_the_mean_of_all_its_ends(
    tmp_path: Path, solved: float, training: dict[str, float], share: float
) -> None:
    begun = commands(Options(run=tmp_path / "run", before=finished(tmp_path / "before", solved=solved, **training)))
    programs = {"expert-iteration": mujoban_planner.train.ExpertIteration}
    options = read_options(programs, begun["planner"][2:], "planner")
    assert options.config.init_share == pytest.approx(share, abs=1e-3)


def test_a_planner_without_a_record_is_refused_before_anything_begins(tmp_path: Path) -> None:
    before, run = finished(tmp_path / "before"), tmp_path / "run"
    (before / PRODUCTS["planner"]).with_suffix(".json").unlink()
    with pytest.raises(ValueError, match=r"planner\.json: no record beside the weights; expected a JSON file"):
        train_all(Options(run=run, before=before))
    assert not run.exists()


def test_modules_that_are_kept_are_those_of_the_run_before_and_the_others_go_on(tmp_path: Path) -> None:
    before, run = finished(tmp_path / "before"), tmp_path / "run"
    (before / "estimator_first" / "weights").mkdir(parents=True)
    (before / "controller_mpo" / "checkpoint-1.json").touch()
    found = {stage.name: stage for stage in stages(Options(run=run, before=before, keep=("controller", "senses")))}
    trained = {name for name, stage in found.items() if stage.command[1] != bringup.keep.PROG}
    assert trained == {"planner", *EVALUATIONS}, "and nothing is recorded, since the senses learn nothing"
    for name in found.keys() - trained:
        bringup.keep.main(found[name].command[2:])
        assert all(product.exists() for product in found[name].products)
    kept = {Path(path).parts[0] for role, path in WEIGHTS.items() if role != "planner"}
    assert all(kept & set(found[name].needs) == kept for name in EVALUATIONS)
    assert not [*run.rglob("checkpoint-*")] and not (run / "planner").exists()


def test_what_is_kept_must_be_of_a_run() -> None:
    with pytest.raises(ValueError, match="--keep planner: expected --continue"):
        Options(keep=("planner",))


def test_a_run_whose_bags_are_gone_is_continued_with_new_ones_alone(tmp_path: Path) -> None:
    before, run = finished(tmp_path / "before"), tmp_path / "run"
    for name in ("first", "second"):
        (before / PRODUCTS[name]).unlink()
    first = commands(Options(run=run, before=before))["estimator_first"]
    assert first[first.index("--bags") + 1 : first.index("--out")] == (str(run / PRODUCTS["first"]),)


def test_a_stage_that_is_done_keeps_its_bags_when_those_before_are_gone(tmp_path: Path) -> None:
    before, run = finished(tmp_path / "before"), tmp_path / "run"
    done = commands(Options(run=run, before=before))["estimator_first"]
    run.mkdir()
    (run / "pipeline.json").write_text(json.dumps({"estimator_first": {"command": done, "done": True}}))
    (before / PRODUCTS["first"]).unlink()
    found = commands(Options(run=run, before=before))
    assert found["estimator_first"] == done and str(before / PRODUCTS["first"]) not in found["estimator_second"]


def test_a_body_that_finds_its_heading_by_sight_looks_around_before_it_learns(tmp_path: Path) -> None:
    ball, ant = (commands(Options(run=tmp_path, physics=WorldOptions(body))) for body in ("ball", "ant"))
    for stage in ("controller_distil", "controller_mpo"):
        student = ant[stage]
        assert student[student.index("--task.look") + 1] == "50" and "--task.look" not in ball[stage]
    assert "--task.instructions.stay" in ant["teacher"] and "--task.instructions.stay" not in ball["teacher"]


def test_a_body_that_no_single_action_turns_has_a_teacher_by_ppo_and_no_critic(tmp_path: Path) -> None:
    before, run, ant = finished(tmp_path / "before"), tmp_path / "run", WorldOptions("ant")
    (before / PRODUCTS["critic"]).unlink()
    found = {stage.name: stage for stage in stages(Options(run=run, before=before, physics=ant))}
    teacher, student = found["teacher"], found["controller_mpo"]
    assert teacher.command[teacher.command.index("--algorithm") + 1] == "ppo"
    assert teacher.products == (run / PRODUCTS["teacher"],)
    assert "--critic" not in teacher.command and "--critic" not in student.command
    with pytest.raises(ValueError, match=r"lacks teacher/critic\.safetensors"):
        Options(run=run, before=before)


@pytest.mark.parametrize(("body", "other"), [("ball", "ant"), ("ant", "ball")])
def test_a_run_of_another_body_is_refused_before_anything_begins(tmp_path: Path, body: str, other: str) -> None:
    before, run = finished(tmp_path / "before"), tmp_path / "run"
    entries = commands(Options(run=before, physics=WorldOptions(body)))
    noted = {name: {"command": command, "done": True} for name, command in entries.items()}
    (before / "pipeline.json").write_text(json.dumps(noted))
    assert Options(run=run, before=before, physics=WorldOptions(body)).physics.body == body
    with pytest.raises(ValueError, match=rf"^--body {other}: --continue .*before is a run of the {body}, expected it$"):
        Options(run=run, before=before, physics=WorldOptions(other))


@pytest.mark.parametrize("name", EVALUATIONS)
def test_an_evaluation_plays_levels_by_which_nothing_is_chosen(tmp_path: Path, name: str) -> None:
    command = commands(Options(run=tmp_path))[name]
    seed, episodes = (int(command[command.index(option) + 1]) for option in ("--seed", "--episodes"))
    played = range(seed, seed + episodes)
    # Controllers keep what solves most of the first levels for validation, planners of those from 9,000,000 on.
    chosen_by = (range(VALIDATION_SEEDS.start, VALIDATION_SEEDS.start + 64), range(9_000_000, VALIDATION_SEEDS.stop))
    assert seed_range(seed, episodes) == "validation" and not any(set(played) & set(seeds) for seeds in chosen_by)


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--hours", "inf", "a positive number"),
        ("--evaluation-episodes", "0", "a whole number from 1 on"),
        ("--cores", "0", "a whole number from 1 on"),
        ("--world", "moon", "one of "),
        ("--seed", "-1", "a whole number from 0 on"),
        ("--seed", "10000000000", "a whole number from 0 to "),
    ],
)
def test_bad_options_are_refused_before_anything_runs(option: str, value: str, expected: str) -> None:
    with pytest.raises(ValueError, match=f"{option} .*{value}.* expected {expected}"):
        read_options(Options, [option, value], "train_all")


def test_the_largest_seed_has_levels_for_every_training(tmp_path: Path) -> None:
    seed = LAST_SEED
    for name, command in commands(Options(run=tmp_path, seed=seed)).items():
        if name.startswith("planner"):
            stream = stream_number(int(command[command.index("--seed") + 1]), 999)
            TrainingLevels(stream)
        elif name in ("bags_first", "bags_second"):
            first, episodes = (int(command[command.index(option) + 1]) for option in ("--seed", "--episodes"))
            assert seed_range(first, episodes) == "training"
    with pytest.raises(ValueError, match=f"expected a whole number from 0 to {seed}"):
        Options(seed=seed + 1)


def test_a_run_that_goes_on_has_levels_of_its_own(tmp_path: Path) -> None:
    before = finished(tmp_path / "before")
    first = commands(Options(run=before))
    entries = {name: {"command": command, "done": True} for name, command in first.items()}
    (before / "pipeline.json").write_text(json.dumps(entries))
    more = commands(Options(run=tmp_path / "more", before=before))
    for name in ("teacher", "planner", "bags_first", "bags_second", "estimator_first"):
        old, new = (command[command.index("--seed") + 1] for command in (first[name], more[name]))
        assert old != new
    assert more["planner"][more["planner"].index("--seed") + 1] == "1"
    assert Options(run=tmp_path / "more", before=before, seed=7).stream == 7
    with pytest.raises(ValueError, match=r"--seed 0: the levels of .*before again, expected another seed"):
        Options(run=tmp_path / "more", before=before, seed=0)


def test_the_senses_are_judged_on_bags_of_which_they_learn_nothing(tmp_path: Path) -> None:
    found = commands(Options(run=tmp_path))
    recorded = found["bags_validation"]
    first, episodes = (int(recorded[recorded.index(option) + 1]) for option in ("--seed", "--episodes"))
    assert seed_range(first, episodes) == "validation"
    for name in ("estimator_first", "estimator_second"):
        command, folder = found[name], str(tmp_path / "bags_validation")
        assert command[command.index("--validation") + 1] == folder
        assert folder not in command[command.index("--bags") : command.index("--out")]


def test_continuing_what_is_not_finished_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--continue .* lacks .*, expected the directory of a finished run"):
        Options(run=tmp_path / "run", before=tmp_path)


def test_every_stage_but_the_planners_is_told_the_body_and_the_world(tmp_path: Path) -> None:
    physics = WorldOptions("ant", "eased")
    for name, command in commands(Options(run=tmp_path, physics=physics)).items():
        told = {command[i + 1] for i, option in enumerate(command) if option.endswith("body")}
        assert told == (set() if name.startswith("planner") else {"ant"}), name
        assert "eased" in command or name.startswith(("planner", "estimator")), name


@pytest.mark.parametrize("continued", [False, True])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("body", ["ball", "ant"])
def test_programs_know_the_options_that_they_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, continued: bool, device: str, body: str
) -> None:
    # What is told of a GPU can be read where there is none.
    monkeypatch.setattr(mujoban_controller.train, "usable_device", torch.device)
    before = finished(tmp_path / "before") if continued else None
    programs: dict[str, Any] = {
        "mujoban_controller.train": mujoban_controller.train.Options,
        "mujoban_estimator.train": mujoban_estimator.train.Options,
        "mujoban_planner.train": {"expert-iteration": mujoban_planner.train.ExpertIteration},
        "bringup.record": bringup.record.Options,
        "bringup.evaluate": bringup.evaluate.Options,
    }
    run = Options(run=tmp_path / "run", before=before, device=device, cores=16, physics=WorldOptions(body))
    for name, command in commands(run).items():
        options = read_options(programs[command[1]], command[2:], name)
        assert getattr(options, "run", tmp_path / "run" / name) == tmp_path / "run" / name


def test_a_gpu_is_given_its_time_by_the_clock_and_work_for_all_cores_beside_it(tmp_path: Path) -> None:
    run = Options(run=tmp_path, hours=0.5, device="cuda", cores=16)
    found = {stage.name: stage for stage in stages(run)}
    trainings = [stage for stage in found.values() if "--run" in stage.command]
    assert len(trainings) == 6
    for stage in trainings:
        command = stage.command
        assert command[command.index("--device") + 1] == "cuda"
        assert 0.9 * stage.seconds < float(command[command.index("--horizon-seconds") + 1]) < stage.seconds
        assert float(command[command.index("--cpu-seconds") + 1]) > 100 * run.hours * 3600
    for controller in ("teacher", "controller_distil", "controller_mpo"):
        assert found[controller].cores + found["planner"].cores == 12
    assert all(found[f"estimator_{round_}"].cores == run.cores for round_ in ("first", "second"))


def test_the_report_stands_beside_weights_with_their_cards(tmp_path: Path) -> None:
    finished(tmp_path)
    record = {
        "class": "ResidualPlanner", "parameters": 1000, "digest": "0" * 64, "command": "python -m train", "config": {},
        "training": {"seed": 0}, "metrics": {"success_rate/5": 0.75}, "samples": 12, "updates": 3,
    }  # fmt: skip
    for path in WEIGHTS.values():
        (tmp_path / path).with_suffix(".json").write_text(json.dumps(record))
    outcome = {"success_rate": 0.5, "success_interval": [0.1, 0.9], "mean_return": 7.0}
    outcome |= {"failures": {}, "episodes": [1, 2]}
    (tmp_path / "evaluation.json").write_text(json.dumps(outcome))
    ran = {"teacher": ["-m", bringup.keep.PROG], "controller_mpo": ["-m", "mujoban_controller.train"]}
    (tmp_path / "pipeline.json").write_text(json.dumps({name: {"command": words} for name, words in ran.items()}))
    for name, steps in (("teacher", 500), ("controller_mpo", 7)):
        (tmp_path / name / "metrics.jsonl").write_text(json.dumps({"step": steps}) + "\n")
    options = Options(run=tmp_path)
    text = write_report(tmp_path, Pipeline(tmp_path, stages(options)), WEIGHTS).read_text()
    assert "levels of difficulty 5, seeds from 7000000, by which no stage chooses" in text
    assert "| planner |" in text and "| teacher (kept" in text and "and 7 environment steps" in text
    title = "all four modules, the planner's policy alone"
    assert f"| {title} | 2 | **50.0%** | 10.0% to 90.0% | 7.00 | none |" in text and "search ahead" not in text
    assert "success_rate/5 0.75" in text
    card = (tmp_path / "weights" / "planner.md").read_text()
    assert f"| {title} | none | 2 | 50.0 % | 10.0 to 90.0 % |" in card and "| success_rate/5 | 0.75 |" in card
