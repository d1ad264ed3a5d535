"""Reports as JSON, and the uses of levels for tests that they list.

Results come from levels that nothing was tuned on: whoever evaluates on them again and again tunes on them after all.
So a report says by which code and weights they were used, and a file that is written anew keeps what it said before.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mujoban_core.files import write_atomically


def use_of_test_levels(
    commit: str | None, weights: Mapping[str, str], seeds: tuple[int, int], played: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the entry of a report's `test_uses` list: what was evaluated on test levels, on which, and how.

    Args:
        commit: Of the code.
        weights: What identifies each module.
        seeds: Of the first and the last level.
        played: How; None where that is not known.
    """
    return {"commit": commit, "weights": dict(weights), "seeds": list(seeds), "played": played}


def write_report(content: Mapping[str, Any], path: Path, *, indent: int | None = 2) -> None:
    """Write a report as JSON, whole or not at all; uses of the test range that the file lists are kept.

    Args:
        content: The report.
        path: Its file.
        indent: Of nested lines; None for a single line.
    """
    if path.is_file() and "test_uses" in content:
        content = {**content, "test_uses": [*_noted_uses(path), *content["test_uses"]]}
    write_atomically(path, (json.dumps(content, indent=indent) + "\n").encode())


def give_report(report: Mapping[str, Any], file: Path | None) -> None:
    """Print a report as JSON, or write it to a file if there is one."""
    if file is None:
        print(json.dumps(report, indent=2))
    else:
        write_report(report, file)


def _noted_uses(path: Path) -> list[Any]:
    try:
        earlier = json.loads(path.read_text())
    except json.JSONDecodeError:
        return []
    return list(earlier.get("test_uses", [])) if isinstance(earlier, dict) else []
