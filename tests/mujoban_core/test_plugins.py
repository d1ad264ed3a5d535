"""Modules of a user's own that cannot be used are named with what was expected of them."""

import re

import pytest

from mujoban_core.plugins import PluginError, load_module


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


def test_a_module_of_which_an_import_fails_is_named(tmp_path, monkeypatch):
    (tmp_path / "their_planner.py").write_text("from mujoban_core.interfaces import Plannner\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PluginError, match=r"their_planner:Mine.*cannot import name 'Plannner'"):
        load_module("planner", "their_planner:Mine")
