"""What an episode came to, and the report over many of them that the commands print as JSON."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Self

from mujoban_core.plugins import PRIVILEGED, TOLD, privileged_roles
from mujoban_core.stats import wilson_interval


class Failure(StrEnum):
    """Why an episode was not solved, and what that means; `bringup.failure` tells which."""

    meaning: str

    def __new__(cls, value: str, meaning: str) -> Self:
        """Return a cause by its name."""
        cause = str.__new__(cls, value)
        cause._value_, cause.meaning = value, meaning
        return cause

    WRONG_ESTIMATE = (
        "wrong estimate",
        "the decision that lost the level, or most of the last ones, rested on a wrong abstract state",
    )
    PLANNER_DEAD_END = (
        "planner dead end",
        "on a right estimate the planner made the level unsolvable, or ran in a loop",
    )
    CONTROLLER_TIME_OUT = "controller time-out", "instructions ran into their time limit"
    MISEXECUTION = (
        "misexecution",
        "a right instruction led to another state than the rules say, and that state is unsolvable",
    )
    LEVEL_LOST = "level lost", "an agent without modules brought the level into a state that is unsolvable"
    TIME_LIMIT = "time limit", "none of these: the time ran out while the level could still be solved"


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """Outcome of one episode."""

    seed: int
    solved: bool
    episode_return: float
    steps: int
    instructions: int
    """Instructions issued."""
    time_outs: int
    """Instructions that ran into their time limit."""
    wrong_estimates: int
    """Instructions that were decided on a wrong abstract state."""
    failure: Failure | None

    def to_json(self) -> dict[str, Any]:
        """Return the entry of a report's `episodes` list."""
        entry = asdict(self)
        entry["return"] = entry.pop("episode_return")
        entry["failure"] = None if self.failure is None else str(self.failure)
        return entry


def report(results: Sequence[EpisodeResult], weights: Mapping[str, str], **extra: Any) -> dict[str, Any]:
    """Return the report of an evaluation.

    Args:
        results: The episodes, at least one.
        weights: Name of each module -> digest of its weights, or the class that stands in for it.
        **extra: Further entries, e.g. `ticks_per_second`.
    """
    if not results:
        raise ValueError("a report needs at least one finished episode")
    solved = sum(r.solved for r in results)
    failures = Counter(str(r.failure) for r in results if r.failure is not None)
    return {
        "success_rate": solved / len(results),
        "success_interval": [float(bound) for bound in wilson_interval(solved, len(results))],
        "mean_return": sum(r.episode_return for r in results) / len(results),
        "mean_steps": sum(r.steps for r in results) / len(results),
        "failures": dict(failures.most_common()),
        **extra,
        "weights": dict(weights),
        "privileged": privileged_roles(weights),
        "episodes": [r.to_json() for r in results],
    }


_DIGITS = 12
"""Of a digest that a summary shows: enough to tell weights apart, in a terminal of 60 columns."""
_SEEDS_SHOWN = 12
"""Seeds of episodes that a text names, of each kind."""


def summary(content: Mapping[str, Any]) -> list[str]:
    """Return a report in a few lines: rate, interval and return, then the seeds of lost episodes by cause."""
    episodes = content["episodes"]
    solved = sum(entry["solved"] for entry in episodes)
    low, high = (100 * bound for bound in content["success_interval"])
    head = (
        f"solved {solved} of {len(episodes)} ({100 * content['success_rate']:.1f} %, 95 % interval {low:.1f} to "
        f"{high:.1f} %), mean return {content['mean_return']:.2f}"
    )
    lines = [head]
    if "ticks_per_second" in content:
        lines[0] += f", {content['ticks_per_second']:.0f} ticks/s"
    if "interrupted" in content:
        lines.append(f"interrupted: {content['interrupted']} episodes were asked for, and long ones are missing most")
    for cause in content["failures"]:
        seeds = [entry["seed"] for entry in episodes if entry["failure"] == cause]
        lines.append(f"lost by {cause}: {counted(seeds)}")
    lines += told(content["weights"])
    return lines + [f"{event}: {count}" for event, count in sorted(content.get("counts", {}).items())]


def counted(seeds: Sequence[int]) -> str:
    """Return how many seeds there are, and in brackets the first `_SEEDS_SHOWN` of them."""
    more = f" and {len(seeds) - _SEEDS_SHOWN} more" if len(seeds) > _SEEDS_SHOWN else ""
    return f"{len(seeds)} (seeds {', '.join(map(str, seeds[:_SEEDS_SHOWN]))}{more})" if seeds else "0"


def told(weights: Mapping[str, str]) -> list[str]:
    """Return a line that names who is told the ground truth, and what that is; none where nobody is.

    Args:
        weights: Name of each module -> what identifies it, see `report`.
    """
    named = [f"{role}: {_brief(weights[role])}" for role in privileged_roles(weights)]
    return [f"{TOLD}: {', '.join(named)}"] if named else []


def told_roles(weights: Mapping[str, str]) -> str:
    """Return the roles that are told the ground truth, as bags name them; `none` where there is none."""
    return ", ".join(privileged_roles(weights)) or "none"


def _brief(identity: str) -> str:
    """Return what plays a role for a line of which all are privileged: of a digest the first digits."""
    name = identity.removesuffix(PRIVILEGED)
    return f"weights {name[:_DIGITS]}" if re.fullmatch("[0-9a-f]{64}", name) else name
