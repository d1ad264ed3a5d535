"""What a report on generated levels lists when they are those for tests (see `mujoban_core.reports`)."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from mujoban_rl.weights import provenance
from mujoban_sokoban.generator import seed_range


def noted_use(first: int, count: int, weights: Mapping[str, str], played: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry `test_uses` of a report on `count` levels with the seeds from `first` on; none of others.

    It lists what was evaluated, on which levels, by which code, how and when; `mujoban_core.reports.count_uses` counts.

    Args:
        first: Seed of the first level.
        count: Number of levels.
        weights: What identifies each module.
        played: How.

    Raises:
        ValueError: If the seeds do not all lie in one range.
    """
    if seed_range(first, count) != "test":
        return {}
    use = {
        "commit": provenance()["commit"], "weights": dict(weights), "seeds": [first, first + count - 1],
        "played": dict(played), "when": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip
    return {"test_uses": [use]}
