"""What a report on generated levels lists when they are those for tests (see `mujoban_core.reports`)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mujoban_core.commit import commit_of
from mujoban_sokoban.generator import seed_range


def noted_use(seeds: Collection[int], weights: Mapping[str, str], played: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry `test_uses` of a report on generated levels with these seeds; none of others.

    It lists what was evaluated, on which levels, by which code, how and when; `mujoban_core.reports.count_uses` counts.

    Args:
        seeds: Of the levels, at least one; of those between the first and the last it may lack some.
        weights: What identifies each module.
        played: How.

    Raises:
        ValueError: If the seeds do not all lie in one range.
    """
    first, last = min(seeds), max(seeds)
    if seed_range(first, last - first + 1) != "test":
        return {}
    use = {
        "commit": commit_of(Path(__file__)), "weights": dict(weights), "seeds": [first, last],
        "played": dict(played), "when": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip
    return {"test_uses": [use]}
