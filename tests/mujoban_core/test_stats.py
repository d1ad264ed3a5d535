"""Intervals of success rates and of their differences, by published numbers."""

import math

import pytest

from mujoban_core.stats import NORMAL_95, design_effect, paired_difference, rate_error, sign_test, wilson_interval


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (0, 20), (20, 20), (950, 1000)])
def test_wilson_interval_holds_the_rate(successes, n):
    low, high = wilson_interval(successes, n)
    assert 0.0 <= low <= (successes / n if n else 0.0) <= high <= 1.0


def test_wilson_interval_matches_the_published_formula_and_rejects_nonsense():
    # 95 %: Newcombe 1998, table I, method 3
    for counts, published in {
        (81, 263): (0.2553, 0.3662), (15, 148): (0.0624, 0.1605), (0, 20): (0.0, 0.1611), (1, 29): (0.0061, 0.1718),
    }.items():  # fmt: skip
        assert wilson_interval(*counts) == pytest.approx(published, abs=6e-5)
    with pytest.raises(ValueError, match="successes"):
        wilson_interval(3, 2)


def test_the_interval_of_a_difference_of_paired_rates_is_as_published():
    # Of 1600, 150 changed one way and 86 the other: Agresti 2002, section 10.1, -0.04 with a standard error of 0.0095.
    assert paired_difference(150, 86, 1600) == pytest.approx((-0.04, -0.0586, -0.0214), abs=3e-4)


def test_the_interval_of_a_difference_is_walds_with_half_a_trial_more_in_each_cell():
    first, second, n = (1 + 0.5) / 12, (4 + 0.5) / 12, 10 + 4 * 0.5
    half = NORMAL_95 * math.sqrt((first + second - (second - first) ** 2) / n)
    expected = (0.3, second - first - half, second - first + half)
    assert paired_difference(1, 4, 10) == pytest.approx(expected)
    assert paired_difference(0, 10, 10)[2] == 1.0 and paired_difference(10, 0, 10)[1] == -1.0


def test_the_error_of_a_rate_counts_a_success_and_a_failure_more():
    found = [rate_error(successes, 8) for successes in (0, 4, 8)]
    assert found == pytest.approx([math.sqrt(rate * (1 - rate) / 10) for rate in (0.1, 0.5, 0.9)])


def test_trials_that_are_alike_count_as_fewer():
    # Sums of the clusters about the mean, 0.5: 1.5, -0.5 and -1; of the trials' squares about it: 6 / 4.
    outcomes, clusters = [1, 1, 1, 0, 0, 0], ["a", "a", "a", "b", "c", "c"]
    assert design_effect(outcomes, clusters) == pytest.approx(1.5 * (1.5**2 + 0.5**2 + 1.0**2) / 1.5)
    assert design_effect(outcomes, range(6)) == pytest.approx(6 / 5) and design_effect([1, 0, 1, 0], "aabb") == 1.0
    assert design_effect([1, 1, 1], "aab") == 1.5, "of what does not differ: as many as there are clusters"


def test_more_evidence_narrows_the_interval_and_lowers_the_chance():
    few, many = paired_difference(2, 6, 40), paired_difference(20, 60, 400)
    assert few[0] == many[0] == pytest.approx(0.1)
    assert few[1] < 0.0 < many[1] < many[0] < many[2] < few[2]
    assert sign_test(20, 60) < 1e-4 < 0.05 < sign_test(2, 6)
    assert sign_test(1, 5) == sign_test(5, 1) == pytest.approx(2 * 7 / 64)
    assert sign_test(3, 3) == sign_test(0, 0) == 1.0
    assert paired_difference(0, 0, 10)[1] < 0.0 < paired_difference(0, 0, 10)[2]
