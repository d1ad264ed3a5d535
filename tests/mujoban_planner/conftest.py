from functools import partial

import pytest

from mujoban_planner.play import play


@pytest.fixture
def short_validation(monkeypatch):
    """Judge planners by a few moves in four easy levels."""
    monkeypatch.setattr("mujoban_planner.validation._EPISODES", {1: 4})
    monkeypatch.setattr("mujoban_planner.validation.play", partial(play, limit=5))
