"""Model cards say what the records of the shipped weights say."""

import json
import shutil

import pytest

from benchmarks import model_cards
from bringup.model_card import CardError


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
        if record["class"] != "ResidualPlanner":  # which learned from boards alone
            assert f"| world | `{record['world']}` |" in model_cards.card(path), path
