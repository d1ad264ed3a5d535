"""What Table 1 says of difficulty 1, where a level comes under many seeds: intervals, and who is above the floor.

Outcomes of one level depend on each other. Errors are those of sums over distinct levels: what each of them adds to a
rate, or to the difference of two, is one draw.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

from benchmarks.paper.baselines import (
    AGAIN,
    BASELINES,
    HOURS,
    MODULAR,
    Baseline,
    joined,
    points_of,
    solved_in_training,
    steps,
)
from benchmarks.paper.runs import load
from mujoban_core.stats import NORMAL_95, cluster_variance, design_effect, wilson_interval
from mujoban_sokoban.generator import generate_level

_FLOOR: Final = "untrained"
"""The row that the others are compared with."""
_COPIED: Final = "mpo_cloned"
_UNCOPIED: Final = "mpo_curriculum"
"""MPO on the same levels as `_COPIED`, from nothing."""
_CLONE: Final = "clone"
_FEW: Final = 100
"""Episodes in training of which a curve says little."""
_EASIEST: Final = 1
"""The difficulty whose levels come again, and the one at which agents differ."""


class Difference(NamedTuple):
    """Success of one row less that of another, with its 95 % interval."""

    mean: float
    low: float
    high: float


def interval(episodes: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a success rate, wider by the design effect of levels that come again.

    Args:
        episodes: `seed` and `solved` of each, at difficulty 1.
    """
    outcomes = [entry["solved"] for entry in episodes]
    effect = design_effect(outcomes, [_level(entry["seed"]) for entry in episodes])
    return wilson_interval(sum(outcomes), len(outcomes), NORMAL_95 * math.sqrt(effect))


def difference(first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]) -> Difference:
    """Return the difference of two success rates; levels that both have are compared with each other.

    Args:
        first: `seed` and `solved` of each episode, at difficulty 1.
        second: The same of the row that is subtracted.
    """
    ours, theirs = _shares(first), _shares(second)
    mean = sum(e["solved"] for e in first) / len(first) - sum(e["solved"] for e in second) / len(second)
    apart = [ours.get(level, 0.0) - theirs.get(level, 0.0) for level in ours.keys() | theirs.keys()]
    half = NORMAL_95 * math.sqrt(cluster_variance(apart))
    return Difference(mean, mean - half, mean + half)


def _shares(episodes: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return by how much the outcomes on each distinct level move the rate from where it is."""
    rate = sum(entry["solved"] for entry in episodes) / len(episodes)
    shares: dict[str, float] = defaultdict(float)
    for entry in episodes:
        shares[_level(entry["seed"])] += (entry["solved"] - rate) / len(episodes)
    return shares


@cache
def _level(seed: int) -> str:
    return generate_level(_EASIEST, seed).to_text()


def _measured() -> list[tuple[Baseline, list[dict[str, Any]]]]:
    """Return rows whose difficulty 1 has been measured, with its episodes."""
    reports = ((row, load(row.run(_EASIEST))) for row in (*BASELINES, *AGAIN))
    return [(row, report["episodes"]) for row, report in reports if report]


def distinct_levels() -> str:
    """Return how many test levels of difficulty 1 there are, and intervals to go with it; nothing without rows."""
    rows = _measured()
    if not rows:
        return ""
    played = {entry["seed"] for _, episodes in rows for entry in episodes}
    found = ((row.label, interval(episodes)) for row, episodes in rows)
    told = "; ".join(f"{label}, {100 * low:.1f} to {100 * high:.1f} %" for label, (low, high) in found)
    return (
        f"Of the {len(played)} test levels of difficulty 1 {len(set(map(_level, played)))} are distinct, and all are "
        "among 10,000 levels for training ([levels](../levels.md#the-five-difficulties)): the column says how well "
        "levels were learned that can be met in training, not how agents do on others. With copies of a level as one "
        f"draw (Wilson intervals, wider by the design effect), its 95 % intervals are: {told}.\n"
    )


def against_floor() -> str:
    """Return which rows differ from what nobody has trained, at difficulty 1; nothing while that is not measured."""
    rows = _measured()
    floor = next(((row, episodes) for row, episodes in rows if row.name == _FLOOR), None)
    if floor is None:
        return ""
    groups: dict[str, list[str]] = {"above it": [], "below it": [], "not told apart from it": []}
    for row, episodes in rows:
        if row is floor[0]:
            continue
        mean, low, high = difference(episodes, floor[1])
        group = "above it" if low > 0.0 else "below it" if high < 0.0 else "not told apart from it"
        groups[group].append(f"{row.label}, {100 * mean:+.1f} ({100 * low:.1f} to {100 * high:.1f})")
    told = " ".join(f"{group[0].upper()}{group[1:]}: {'; '.join(named) or 'none'}." for group, named in groups.items())
    return (
        f"Against the floor, *{floor[0].title}*, at difficulty 1, in points of success with 95 % intervals (normal; "
        f"outcomes on the same seeds paired, errors clustered by distinct level; each row by itself): {told}\n"
    )


def copying() -> str:
    """Return whether a monolithic network does better that may copy, and what else differs; nothing until measured."""
    rows, played = {row.name: row for row in BASELINES}, {row.name: episodes for row, episodes in _measured()}
    learned = [solved_in_training(points_of(rows[name]), _EASIEST) for name in (_COPIED, _UNCOPIED)]
    if not all(count for _, count in learned) or not {_COPIED, _CLONE, _FLOOR} <= played.keys():
        return ""
    (copied, of), (alone, of_alone) = learned
    better = "It does" if copied / of > alone / of_alone else "It does not"
    above = [rows[name].title for name in (_COPIED, _CLONE) if difference(played[name], played[_FLOOR]).low > 0.0]
    return (
        f"Does a monolithic network do better when it may copy? {better} in training, where torques are drawn and an "
        f"episode has 45 s: of difficulty 1 *{rows[_COPIED].title}* solved {_share(copied, of)}, the row that learned "
        f"on the same levels and copied nothing {_share(alone, of_alone)}. In play, by means and in 240 s, the former "
        f"solves {_rate(played[_COPIED])} of the test levels, the clone alone {_rate(played[_CLONE])}, the floor by "
        f"its noise {_rate(played[_FLOOR])}; above the floor: {', '.join(above) or 'neither'}. The rows differ in more "
        "than what they began with: what goes on from a clone, and the clone, decide in every tick and play by their "
        "means, as the stack does; the other rows of MPO hold each torque for 4 ticks, learn from each step four "
        "times, and play by drawn pink noise. A clone that plays so is not measured.\n"
    )


def _share(solved: int, of: int) -> str:
    low, high = (100 * bound for bound in wilson_interval(solved, of))
    return f"{100 * solved / of:.1f} % of {of} ({low:.1f} to {high:.1f})"


def _rate(episodes: Sequence[Mapping[str, Any]]) -> str:
    return f"{100 * sum(entry['solved'] for entry in episodes) / len(episodes):.1f} %"


def short_curves() -> str:
    """Return which curves have few episodes of difficulty 1, and so few points; nothing where none has."""
    found = ((row, points_of(row)) for row in (*BASELINES, *AGAIN))
    told = [
        f"{row.label}, {count} episodes and {len(joined(points, 'solved', _EASIEST))} points"
        for row, points in found
        if 0 < (count := solved_in_training(points, _EASIEST)[1]) < _FEW
    ]
    return f"Curves of few episodes, counted at difficulty 1: {'; '.join(told)}.\n" if told else ""


def ended_by_steps() -> str:
    """Return how much of their CPU time the rows used that were ended by their steps; nothing where there are none."""
    budget = 2 * 3600 * HOURS
    costs = [points[-1] for row in (*BASELINES, *AGAIN) if row is not MODULAR and (points := points_of(row))]
    ended = [cost for cost in costs if cost["step"] >= steps() and cost["cpu_seconds"] < budget]
    shares = [cost["cpu_seconds"] / budget for cost in ended]
    if not shares:
        return ""
    least, most = (f"{100 * share:.0f}" for share in (min(shares), max(shares)))
    spent = least if least == most else f"{least} to {most}"
    return f"Rows that were ended by their steps used {spent} % of their CPU time.\n"


def seeds() -> str:
    """Return of which seeds the rows are."""
    again = [row.label for row in AGAIN if points_of(row)]
    others = "; ".join(again) or "none"
    return f"A row is one run, of seed 0 where it names no other. Of another seed were run: {others}.\n"
