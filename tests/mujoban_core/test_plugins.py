"""Which module plays; those of a user's own that cannot are named with what was expected of them."""

import re
from functools import partial
from pathlib import Path

import pytest

import mujoban_controller
from bringup.command import Choice, Stack
from mujoban_core.plugins import ORACLE, PluginError, load_module, load_scout, shipped_weights


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("mujoban_core.look_around:LookAroundPlanner", "missing 2 required positional arguments"),
        ("mujoban_core.interfaces:Planner", "Can't instantiate abstract class Planner"),
    ],
)
def test_a_class_that_cannot_be_made_without_arguments_is_named(source, message):
    with pytest.raises(PluginError, match=f"{re.escape(source)}: .*{message}.*expected a planner that is made without"):
        load_module("planner", source)


@pytest.mark.parametrize("source", [ORACLE, "mujoban_sim.oracles:OraclePlanner"])
def test_weights_are_refused_by_what_takes_none(source):
    with pytest.raises(PluginError, match=rf"the planner {source} takes no weights, expected none; got mine\.safe"):
        load_module("planner", source, Path("mine.safetensors"))


def test_what_names_no_module_is_told_all_that_would():
    with pytest.raises(PluginError, match=r"planner': .*Class, weights \(\.safetensors\) or one of"):
        Choice.parse("planner", "runs/plans/planner").load()


@pytest.mark.parametrize("role", ["agent", "scout"])
def test_what_learned_but_does_not_ship_needs_weights(role):
    with pytest.raises(PluginError, match=rf"the learned {role}: none of its weights ship, expected some"):
        shipped_weights(role)


@pytest.mark.parametrize(("load", "names"), [(partial(load_module, "agent"), "random"), (load_scout, "scripted")])
def test_learned_is_no_name_for_what_does_not_ship(load, names):
    with pytest.raises(PluginError, match=rf"is named 'nobody': .*or one of {names}$"):
        load("nobody")


def test_a_module_of_which_an_import_fails_is_named(tmp_path, monkeypatch):
    (tmp_path / "their_planner.py").write_text("from mujoban_core.interfaces import Plannner\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PluginError, match=r"their_planner:Mine.*cannot import name 'Plannner'"):
        load_module("planner", "their_planner:Mine")


def test_a_body_plays_with_the_weights_that_ship_for_it(tmp_path, monkeypatch):
    monkeypatch.setattr(mujoban_controller, "SHIPPED", tmp_path / "controller_ball.safetensors")
    for body in ("ball", "ant"):
        (tmp_path / f"controller_{body}.safetensors").touch()
    assert shipped_weights("controller", "ant") == tmp_path / "controller_ant.safetensors"
    assert shipped_weights("controller", "cart") == shipped_weights("controller") == mujoban_controller.SHIPPED
    played = Stack(body="ant").choices
    assert played["controller"].weights == tmp_path / "controller_ant.safetensors"
    assert played["planner"].weights is None
    own = Choice("controller", weights=tmp_path / "mine.safetensors")
    assert Stack({"controller": own}, body="ant").choices == {"controller": own}
    driver = Stack({"controller": Choice("controller", ORACLE)}, body="ant").choices["controller"]
    assert driver.weights == mujoban_controller.teacher_weights("ant"), "the script drives the ball alone"
