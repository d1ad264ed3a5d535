"""Reports as JSON, and the uses of levels for tests that they list.

Results come from levels that nothing was tuned on: whoever evaluates on them again and again tunes on them after all.
So a report says by which code and weights they were used, and a file that is written anew keeps what it said before.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mujoban_core.files import write_atomically
from mujoban_core.program import say


def count_uses(uses: Iterable[Mapping[str, Any]]) -> int:
    """Return how often test levels were used, by the entries of a report's `test_uses` list.

    A use is an evaluation of some weights in some game. Entries of the same weights and game are parts of one while no
    level comes twice among them; with each further time that it does they are one evaluation more. An entry that is
    there twice, word for word, was written down twice and counts once.

    Args:
        uses: What `mujoban_rl.sealed_levels.noted_use` returns.
    """
    steps: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for text in dict.fromkeys(json.dumps(use, sort_keys=True) for use in uses):
        use = json.loads(text)
        # Parts begin with different levels.
        game = {key: value for key, value in (use["played"] or {}).items() if key != "seed"}
        first, last = use["seeds"]
        steps[json.dumps([use["weights"], game])] += [(first, 1), (last + 1, -1)]
    return sum(_most_at_once(changes) for changes in steps.values())


def _most_at_once(changes: Iterable[tuple[int, int]]) -> int:
    """Return how many intervals overlap at most, given where each begins (+1) and where it is over (-1)."""
    most = now = 0
    for _, change in sorted(changes):
        now += change
        most = max(most, now)
    return most


def noted_uses(path: Path) -> list[dict[str, Any]]:
    """Return the uses of the test range that a report lists; none where there is no report, or a damaged one."""
    try:
        report = json.loads(path.read_text())
    except (FileNotFoundError, ValueError):
        return []
    return list(report.get("test_uses", [])) if isinstance(report, dict) else []


def write_report(content: Mapping[str, Any], path: Path, *, indent: int | None = 2) -> None:
    """Write a report as JSON, whole or not at all; uses of the test range that the file lists are kept.

    Args:
        content: The report.
        path: Its file.
        indent: Of nested lines; None for a single line.
    """
    if "test_uses" in content:
        noted = noted_uses(path)
        content = {**content, "test_uses": [*noted, *(use for use in content["test_uses"] if use not in noted)]}
    write_atomically(path, (json.dumps(content, indent=indent) + "\n").encode())


def keep_report(report: Mapping[str, Any], file: Path | None) -> None:
    """Write a report to a file if there is one; otherwise say on stderr which uses of test levels are noted nowhere."""
    if file is not None:
        write_report(report, file)
        return
    for first, last in (use["seeds"] for use in report.get("test_uses", ())):
        say(f"test levels were used, seeds {first} to {last}, and this is written nowhere: --json FILE notes it")


def give_report(report: Mapping[str, Any], file: Path | None) -> None:
    """Print a report as JSON, or write it to a file if there is one."""
    if file is None:
        print(json.dumps(report, indent=2))
    keep_report(report, file)
