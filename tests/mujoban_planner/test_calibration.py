"""Whether pushes are deadly as often as the planner says."""

import json

import numpy as np
import pytest

from mujoban_planner import load
from mujoban_planner.calibration import Verdicts, main, reliability, verdicts
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.teacher import Teacher
from mujoban_planner.validation import validation_levels


def test_reliability_compares_what_was_said_with_what_is():
    said = np.array([0.02, 0.04, 0.52, 0.58, 1.0, 1.0])
    found = reliability(Verdicts(said, np.array([False, False, True, False, True, True])))
    assert found["n"] == [2, 2, 2] and found["is"] == [0.0, 0.5, 1.0]
    assert found["said"] == pytest.approx([0.03, 0.55, 1.0])
    assert found["calibration_error"] == pytest.approx((0.06 + 0.1 + 0.0) / 6)


def test_verdicts_are_of_the_pushes_whose_outcome_is_known():
    samples = Teacher().demonstrate(validation_levels(3, 8), np.random.default_rng(0))
    found = verdicts(load(compiled=False), samples)
    assert len(found.said) == np.bitwise_count(samples.push_known).sum()
    assert found.dead.sum() == np.bitwise_count(samples.push_dead).sum()
    assert ((found.said > 0.5) == found.dead).mean() > 0.95
    with pytest.raises(ValueError, match="does not judge pushes"):
        verdicts(ResidualPlanner(8, 1), samples)


def test_the_command_draws_and_reports(tmp_path):
    image, report = tmp_path / "calibration.png", tmp_path / "calibration.json"
    assert main(["--episodes", "6", "--difficulty", "2", "--out", str(image), "--json", str(report)]) == 0
    assert image.stat().st_size > 5_000
    assert json.loads(report.read_text())["levels, as they are"]["pushes"] > 10
