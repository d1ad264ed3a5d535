"""Intervals of success rates and of their differences, by published numbers."""

import pytest

from mujoban_core.stats import paired_difference, sign_test, wilson_interval


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (0, 20), (20, 20), (950, 1000)])
def test_wilson_interval_holds_the_rate(successes, n):
    low, high = wilson_interval(successes, n)
    assert 0.0 <= low <= (successes / n if n else 0.0) <= high <= 1.0


def test_wilson_interval_matches_the_published_formula_and_rejects_nonsense():
    # 81/263, 95 %: Newcombe 1998, table I, method 3
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    with pytest.raises(ValueError, match="successes"):
        wilson_interval(3, 2)


def test_the_interval_of_a_difference_of_paired_rates_is_as_published():
    # Of 1600, 150 changed one way and 86 the other: Agresti 2002, section 10.1, -0.04 with a standard error of 0.0095.
    assert paired_difference(150, 86, 1600) == pytest.approx((-0.04, -0.0586, -0.0214), abs=3e-4)


def test_more_evidence_narrows_the_interval_and_lowers_the_chance():
    few, many = paired_difference(2, 6, 40), paired_difference(20, 60, 400)
    assert few[0] == many[0] == pytest.approx(0.1)
    assert few[1] < 0.0 < many[1] < many[0] < many[2] < few[2]
    assert sign_test(20, 60) < 1e-4 < 0.05 < sign_test(2, 6)
    assert sign_test(1, 5) == sign_test(5, 1) == pytest.approx(2 * 7 / 64)
    assert sign_test(3, 3) == sign_test(0, 0) == 1.0
    assert paired_difference(0, 0, 10)[1] < 0.0 < paired_difference(0, 0, 10)[2]
