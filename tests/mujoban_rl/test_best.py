import math

import pytest
import torch
from torch import nn

from mujoban_core.stats import rate_error
from mujoban_rl.best import Best, judged


def product(value):
    module = nn.Linear(1, 1)
    nn.init.constant_(module.weight, value)
    return module


def test_the_newest_of_the_best_is_kept_with_what_was_found():
    best = Best()
    for value, score in enumerate([(0.5, 0.1), (0.5, 0.2), (0.5, 0.2), (0.4, 0.9)]):
        best.judge(product(float(value)), score, {"rate": score[0] + score[1]})
    again = Best()
    again.restore(best.state())
    again.judge(product(9.0), (0.0, 1.0), {})
    assert again.chosen(product(8.0)).weight.item() == 2.0
    assert again.told == {"validation": {"rate": 0.7}, "evaluation": 2}


def test_a_product_that_scores_less_by_no_more_than_chance_takes_the_place():
    best = Best()
    levels, instructions = 64, 2000
    failed = [(0, 0), (0, 1), (1, 0), (0, 3), (3, 0), (2, 2)]
    for value, (lost, missed) in enumerate(failed):
        counts = ((levels - lost, levels), (instructions - missed, instructions))
        errors = tuple(rate_error(*count) for count in counts)
        best.judge(product(float(value)), tuple(k / n for k, n in counts), {}, errors)
        again = Best()
        again.restore(best.state())
        best = again
    # One failure may be chance, two or three are not, and the newest is compared with the best, not with the last kept.
    assert best.told["evaluation"] == 2 and best.chosen(product(8.0)).weight.item() == 2.0


def test_what_is_kept_does_not_change_with_the_product():
    best, learned = Best(), product(1.0)
    best.judge(learned, (1.0,), {})
    nn.init.constant_(learned.weight, 2.0)
    chosen = best.chosen(learned)
    assert chosen.weight.item() == 1.0 and learned.weight.item() == 2.0


def test_without_a_judgement_the_present_product_is_the_best():
    best, present = Best(), product(3.0)
    best.restore(best.state())
    torch.testing.assert_close(dict(best.chosen(present).state_dict()), dict(present.state_dict()))
    assert best.told == {"validation": None, "evaluation": None}


def test_an_evaluation_that_fails_leaves_the_product_in_training():
    learned = product(1.0)
    with pytest.raises(KeyboardInterrupt), judged(learned):
        assert not learned.training
        raise KeyboardInterrupt
    assert learned.training


def test_a_score_that_is_not_a_number_is_never_the_best():
    best = Best()
    for value, score in enumerate([(math.nan,), (0.1,), (0.2, math.nan), (0.0,)]):
        best.judge(product(float(value)), score, {"rate": score[0]})
    assert best.chosen(product(8.0)).weight.item() == 1.0
    assert best.told == {"validation": {"rate": 0.1}, "evaluation": 1}
