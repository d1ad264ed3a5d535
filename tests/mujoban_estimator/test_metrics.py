import numpy as np
import pytest
import torch

from mujoban_estimator.losses import missed_steps
from mujoban_estimator.metrics import MapScores, TerminationScores
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level


def test_missed_steps_count_earlier_negatives_under_a_positive_label():
    completed = torch.tensor([[False, True, True, True, True]])
    logits = torch.tensor([[-1.0, -1.0, -1.0, 1.0, -1.0]])
    assert missed_steps(logits, completed).tolist() == [[0.0, 0.0, 1.0, 2.0, 2.0]]


def test_map_scores_tell_apart_what_was_seen():
    truth = generate_level(5, TRAIN_SEEDS.start).abstract_state()[None]
    blind = truth.copy()
    row, col = np.argwhere(truth[0, ..., 3])[0]
    blind[0, row, col, 3] = 0.0
    seen = np.ones((1, 10, 10), bool)
    seen[0, row, col] = False
    scores = MapScores()
    scores.add(blind, truth, np.zeros_like(seen), seen)
    report = scores.report()
    assert report["box_recall_seen_before"] == 1.0 and report["box_recall_never_seen"] == 0.0
    assert report["boxes_all_right"] == 0.0 and report["wall_accuracy_seen"] == report["agent_accuracy"] == 1.0
    assert report["wall_calibration_error"] == 0.0


@pytest.mark.parametrize(
    ("detection", "precision", "recall", "delay"), [(5, 1.0, 1.0, 1.0), (3, 0.0, None, None), (None, None, 0.0, None)]
)
def test_termination_scores_count_instructions(detection, precision, recall, delay):
    probability, completed = np.zeros(10, np.float32), np.arange(10) >= 4
    if detection is not None:
        probability[detection] = 0.9
    scores = TerminationScores()
    scores.add(probability, completed, 0.5)
    report = scores.report()
    for name, value in (("precision", precision), ("recall", recall), ("mean_delay", delay)):
        found = report[f"termination_{name}"]
        assert found == value or (value is None and np.isnan(found))


@pytest.mark.parametrize(
    ("detection", "onset", "ticks", "on_time"),
    [
        (5, 4, 10, 1.0),
        (2, 4, 10, 1.0),
        (1, 4, 10, 0.0),
        (7, 4, 10, 0.0),
        (None, 4, 10, 0.0),
        (3, None, 10, 0.0),
        (None, None, 10, None),
        (None, 4, 6, None),
        (1, 4, 6, None),
    ],
)
def test_an_end_is_on_time_within_two_ticks_of_completion_where_that_can_be_told(detection, onset, ticks, on_time):
    probability, completed = np.zeros(ticks, np.float32), np.zeros(ticks, bool)
    if onset is not None:
        completed[onset:] = True
    if detection is not None:
        probability[detection] = 0.9
    scores = TerminationScores()
    scores.add(probability, completed, 0.5)
    found = scores.report()["termination_on_time"]
    assert found == on_time or (on_time is None and np.isnan(found))
