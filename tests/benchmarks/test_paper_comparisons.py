"""What the page says of difficulty 1: intervals where levels come again, and which agents are above the floor."""

import json

import pytest
from paper_pages import write

from benchmarks.paper import __main__ as results
from benchmarks.paper import baselines, comparisons
from mujoban_core.stats import wilson_interval

Z = 1.959963984540054


@pytest.fixture
def pairs(monkeypatch):
    """Seeds 0 and 1 have one level, 2 and 3 another, and so on."""
    monkeypatch.setattr(comparisons, "_level", lambda seed: str(seed // 2))


def episodes(*outcomes, first=0):
    return [{"seed": first + i, "solved": bool(outcome)} for i, outcome in enumerate(outcomes)]


@pytest.mark.usefixtures("pairs")
def test_levels_that_come_again_count_by_how_much_alike_they_end():
    # Shares of the two levels in the rate: (0.5 + 0.5) / 4 and the same below 0; variance 2 * (0.25^2 + 0.25^2).
    wider = wilson_interval(2, 4, Z * (0.25 / 0.0625) ** 0.5)
    assert comparisons.interval(episodes(1, 1, 0, 0)) == pytest.approx(wider)
    assert comparisons.interval(episodes(1, 0, 1, 0)) == wilson_interval(2, 4), "never narrower than without levels"
    assert comparisons.interval(episodes(1, 1, 1, 1)) == pytest.approx(wilson_interval(2, 2)), "two levels, all solved"


@pytest.mark.usefixtures("pairs")
def test_a_difference_is_of_what_the_same_levels_came_to():
    better, worse = episodes(1, 1, 1, 0, 0, 0), episodes(1, 0, 0, 0, 0, 0)
    # Each level's share of the difference of the rates, 2 / 6: (1, 1, 0) / 6 less a third of that.
    half = Z * (1.5 * ((1 / 18) ** 2 + (1 / 18) ** 2 + (2 / 18) ** 2)) ** 0.5
    assert comparisons.difference(better, worse) == pytest.approx((1 / 3, 1 / 3 - half, 1 / 3 + half))
    assert comparisons.difference(better, better) == (0.0, 0.0, 0.0), "nothing is left to chance"
    others = episodes(1, 1, 1, 0, 0, 0, first=6)
    mean, low, high = comparisons.difference(better, others)
    assert mean == 0.0 and low < -0.5 and high > 0.5, "levels that are not the same are not compared"


def test_the_page_names_the_rows_that_are_above_what_nobody_trained(folder):
    rows = {row.name: row for row in baselines.BASELINES}
    for name, solved in (("mpo_easy", 150), ("mpo_hard", 61), ("random", 0)):
        write(rows[name].run(1), solved, 200, {"agent": "a" * 64})
    page = results.rebuild(folder).read_text()
    assert "Against the floor" not in page and "Of the 200 test levels of difficulty 1" in page
    write(rows["untrained"].run(1), 60, 200, {"agent": "mujoban_baselines.agents:untrained"})
    page = results.rebuild(folder).read_text()
    (told,) = [line for line in page.splitlines() if line.startswith("Against the floor")]
    above, below, same = (told.split(f"{mark}: ")[1].split(".")[0] for mark in ("Above it", "Below it", "from it"))
    assert above.startswith("MPO, asym") and "(easy), +45.0 (" in told.split("Below it")[0]
    assert "even torques, each tick anew (nothing), -30" in below and same.startswith("MPO, asym")
    assert "(hard), +0.5 (" in told.split("Not told apart")[1]


def note(row, solved, episodes):
    """Note a run of two points, the same share solved in both."""
    counts = {"solved": {"1": solved}, "return": {"1": 0.0}, "episodes": {"1": episodes}}
    points = [{"step": step, "cpu_seconds": 1, "seconds": 1, **counts} for step in (1, 2)]
    row.curve.write_text("".join(json.dumps(point) + "\n" for point in points))


def test_the_page_says_whether_copying_helps_in_training_and_in_play_and_what_differs(folder):
    rows = {row.name: row for row in baselines.BASELINES}
    note(rows["mpo_cloned"], 0.4, 100)
    for name, solved in (("mpo_cloned", 40), ("clone", 60), ("untrained", 50)):
        assert comparisons.copying() == ""
        write(rows[name].run(1), solved, 200, {"agent": "a" * 64})
    assert comparisons.copying() == "", "nothing is known of what copied nothing"
    note(rows["mpo_curriculum"], 0.25, 20)
    told = comparisons.copying()
    low, high = (f"{100 * bound:.1f}" for bound in wilson_interval(80, 200))
    assert "It does in training" in told and f"solved 40.0 % of 200 ({low} to {high})" in told
    assert "copied nothing 25.0 % of 40 (" in told
    assert "the former solves 20.0 % of the test levels, the clone alone 30.0 %, the floor by its noise 25.0 %" in told
    assert "above the floor: cloning of the stack alone." in told and told in results.rebuild(folder).read_text()
    note(rows["mpo_curriculum"], 0.5, 20)
    write(rows["clone"].run(1), 50, 200, {"agent": "a" * 64})
    assert "It does not in training" in comparisons.copying() and "above the floor: neither." in comparisons.copying()


def test_the_page_says_which_curves_are_of_few_episodes(folder):
    rows = {row.name: row for row in baselines.BASELINES}
    note(rows["mpo_easy"], 0.5, 50)
    assert comparisons.short_curves() == ""
    note(rows["vtrace"], 0.5, 25)
    told = comparisons.short_curves()
    vtrace = "V-trace (privileged) (curriculum), 50 episodes and 2 points"
    assert told == f"Curves of few episodes, counted at difficulty 1: {vtrace}.\n"
    assert told in results.rebuild(folder).read_text()


def test_the_page_says_which_rows_their_steps_ended_and_which_seeds_there_are(folder):
    assert "their CPU time" not in (page := results.rebuild(folder).read_text())
    assert "A row is one run, of seed 0 where it names no other. Of another seed were run: none." in page
    nothing = {kind: {} for kind in ("solved", "return", "episodes")}
    rows = {row.name: row for row in (*baselines.BASELINES, *baselines.AGAIN)}
    costs = {"modular": (1000, 7100), "mpo_easy": (1001, 1296), "vtrace_seed1": (1002, 864), "clone": (900, 7201)}
    for name, (step, cpu_seconds) in costs.items():
        rows[name].curve.write_text(json.dumps({"step": step, "cpu_seconds": cpu_seconds, "seconds": 1, **nothing}))
    page = results.rebuild(folder).read_text()
    assert "Rows that were ended by their steps used 12 to 18 % of their CPU time." in page
    assert "Of another seed were run: V-trace (privileged), seed 1 (curriculum)." in page
