"""Model cards say what the records of the shipped weights say."""

import json
import re
import shutil

import pytest

from benchmarks import model_cards
from bringup import model_card
from bringup.model_card import PURPOSES, CardError
from mujoban_planner.explorer import Explorer
from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner, ThinkingPlanner


def test_the_cards_are_up_to_date():
    assert not model_cards.stale(), "run: python -m benchmarks.model_cards"


def test_a_card_that_was_edited_or_lost_its_weights_is_noticed(tmp_path, monkeypatch):
    cards = shutil.copytree(model_cards.CARDS, tmp_path / "models")
    monkeypatch.setattr(model_cards, "CARDS", cards)
    (cards / "planner.md").write_text("# A better planner\n")
    (cards / "gone.md").write_text("# Weights of yesterday\n")
    assert [file.name for file in model_cards.stale()] == ["gone.md", "planner.md"]


def test_weights_that_nobody_described_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(model_cards, "ROOT", tmp_path)
    (tmp_path / "new.json").write_text(json.dumps({"class": "Mystery"}))
    with pytest.raises(CardError, match=r"new\.json: no text about Mystery"):
        model_cards.card(tmp_path / "new.json")


def test_a_card_says_in_which_world_its_weights_were_trained():
    for path in model_cards.records():
        record = json.loads(path.read_text())
        if path.stem != "planner":  # which learned from boards alone
            assert f"| world | `{record['world']}` |" in model_cards.card(path), path


def test_a_card_has_the_metrics_of_its_own_module_and_says_what_is_of_the_whole_run():
    cards = {path.stem: model_cards.card(path) for path in model_cards.records()}
    assert "| boxes_all_right |" in cards["estimator"] and "| termination_precision |" not in cards["estimator"]
    assert "| boxes_all_right |" not in cards["termination"] and "| termination_precision |" in cards["termination"]
    assert "| samples of the whole run |" in cards["teacher_ball"], "the best of its evaluations was kept"
    assert "| samples |" in cards["planner"]


def test_scores_of_another_stack_are_marked(monkeypatch):
    (path,) = (path for path in model_cards.records() if path.stem == "controller_ball")
    mark, note = "| default † | none |", "† Measured with these weights, but with others than ship now beside them"
    monkeypatch.setattr(model_cards, "is_stale", lambda report, run: run.name == "default")
    told = model_cards.card(path)
    assert mark in told and "| difficulty 1 | none |" in told and note in told
    monkeypatch.setattr(model_cards, "is_stale", lambda report, run: False)
    assert "†" not in model_cards.card(path)


def test_a_card_names_what_the_weights_began_with_and_learned_from():
    cards = {path.stem: (json.loads(path.read_text()), model_cards.card(path)) for path in model_cards.records()}
    for stem, name in (
        ("planner", "init"), ("controller_ball", "critic"), ("controller_ant", "teacher"), ("estimator", "bags_digest"),
    ):  # fmt: skip
        record, told = cards[stem]
        assert f"| {name} | `{record[name][:16]}` |" in told
    record, told = cards["estimator"]
    start = [f"{role} `{record['start'][role][:16]}`" for role in ("estimator", "termination")]
    assert f"| start | {', '.join(start)} |" in told


def test_a_record_that_notes_which_evaluation_was_kept_has_it_on_its_card(tmp_path):
    (path,) = (path for path in model_cards.records() if path.stem == "teacher_ball")
    record = json.loads(path.read_text()) | {"evaluation": 2}
    noted = tmp_path / "teacher.json"
    noted.write_text(json.dumps(record))
    told = model_card.card(noted, "teacher.safetensors", model_card.Place("x", None, "levels"))
    assert "| kept | what the run had at its evaluation 2, counted from 0 |" in told
    noted.write_text(json.dumps(record | {"evaluation": 0, "initial": "0" * 64}))
    told = model_card.card(noted, "teacher.safetensors", model_card.Place("x", None, "levels"))
    assert "at its evaluation 0, counted from 0: what it began with, as training made it no better |" in told


def test_the_readme_tells_of_each_module_how_it_learned_and_which_rules_stand_beside_it():
    readme = (model_cards.ROOT / "README.md").read_text()
    told = {name: cells for name, *cells in re.findall(r"docs/models/(\w+)\.md\) \| (.*) \| (.*) \|", readme)}
    assert told.keys() == {"estimator", "termination", "planner", "controller_ball"}
    for path in model_cards.records():
        if path.stem in told:
            record = json.loads(path.read_text())
            purpose = PURPOSES[record["class"]]
            assert told[path.stem] == [purpose.how(record), purpose.beside]


@pytest.mark.parametrize("network", [ResidualPlanner, ThinkingPlanner, RecurrentPlanner, Explorer])
def test_every_network_that_a_trainer_of_planners_makes_has_a_card(network):
    assert network.__name__ in PURPOSES


@pytest.mark.parametrize(
    ("class_name", "record", "how"),
    [
        ("VisuomotorController", {"teacher": "a" * 64, "training": {"stage": "distil"}}, "by a teacher that knows"),
        ("VisuomotorController", {"teacher": "scripted driver", "training": {"stage": "distil"}}, "scripted driver"),
        ("VisuomotorController", {"teacher": None, "training": {"stage": "mpo"}}, "by reward"),
        ("VisuomotorController", {"initial": "b" * 64, "training": {"stage": "mpo"}}, "own play; then by reward"),
        (
            "VisuomotorController", {"initial": "b" * 64, "training": {"stage": "mpo"}, "evaluation": 0},
            "which solved no more levels: the weights from before were kept",
        ),
        ("ThinkingPlanner", {"method": "expert-iteration then ppo over pushes"}, "solver; then by reward, over pushes"),
        ("Explorer", {"method": "mpo, reward for cells that come into view"}, "by reward, for cells seen"),
    ],
)
def test_how_weights_learned_is_what_their_own_record_says(class_name, record, how):
    assert how in PURPOSES[class_name].how(record)
