"""Compare two reports of the same levels: `python -m bringup.compare FIRST.json SECOND.json`.

Reports are what `bringup/evaluate.py --json` writes. Each level that both played is a pair: what tells the two apart
are the levels that only one of them solved. So the interval is narrower than those of the two rates. Copies of a level
under other seeds, which most of difficulty 1 have, are one draw.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from bringup.results import counted, told
from mujoban_core.program import read_options, run_command
from mujoban_core.stats import NORMAL_95, design_effect, paired_difference, sign_test
from mujoban_sokoban.generator import generate_level

PROG: Final = "bringup.compare"
_LEVELS: Final = ("difficulty", "level_file_sha256")
"""Entries of a report's `played` that make a seed another level."""
_WHERE: Final = ("seed", "level_file")
"""Those that say where its levels are from."""


@dataclass(frozen=True)
class Options:
    """Compare two reports."""

    first: Annotated[Path, tyro.conf.Positional]
    """Report of the one."""
    second: Annotated[Path, tyro.conf.Positional]
    """Report of the other, on the same levels."""


def compare(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Return in a few lines whether the second report is of a better player than the first.

    Raises:
        ValueError: If they have no level in common.
    """
    played = [report["played"] for report in (first, second)]
    solved = [{entry["seed"]: bool(entry["solved"]) for entry in report["episodes"]} for report in (first, second)]
    same = all(played[0].get(key) == played[1].get(key) for key in _LEVELS)
    levels = sorted(solved[0].keys() & solved[1].keys()) if same else []
    if not levels:
        raise ValueError("the reports have no level in common: expected two of the same difficulty or file, and seeds")
    alone = [[seed for seed in levels if solved[a][seed] and not solved[1 - a][seed]] for a in (0, 1)]
    lost, won, n = len(alone[0]), len(alone[1]), len(levels)
    texts = [_level(played[0], seed) for seed in levels]
    distinct = len(set(texts))
    effect = design_effect([solved[1][seed] - solved[0][seed] for seed in levels], texts) if distinct < n else 1.0
    mean, low, high = (100 * value for value in paired_difference(lost, won, n, NORMAL_95 * math.sqrt(effect)))
    copies = f"copies of a level are one draw, {distinct} are distinct"
    chance = copies if distinct < n else f"sign test p = {sign_test(lost, won):.2g}"
    rates = [f"{100 * sum(one[seed] for seed in levels) / n:.1f} %" for one in solved]
    return [
        f"{n} levels in common: the first solved {rates[0]}, the second {rates[1]}",
        f"the first alone solved {counted(alone[0])}, the second alone {counted(alone[1])}",
        f"the second less the first: {mean:+.1f} points (95 % interval {low:+.1f} to {high:+.1f}); {chance}",
        *_otherwise(*played),
        *_told("the first", first),
        *_told("the second", second),
    ]


def _level(played: Mapping[str, Any], seed: int) -> str:
    """Return what tells a level from others: of a file that is its number."""
    difficulty = played.get("difficulty")
    return str(seed) if difficulty is None else generate_level(difficulty, seed).to_text()


def _otherwise(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Return a line that names what was played otherwise, if something was."""
    keys = sorted((first.keys() | second.keys()) - {*_LEVELS, *_WHERE})
    apart = [f"{key} {first.get(key)} and {second.get(key)}" for key in keys if first.get(key) != second.get(key)]
    return [f"played otherwise: {', '.join(apart)}"] if apart else []


def _told(which: str, report: Mapping[str, Any]) -> list[str]:
    """Return a line that names who of a report's player is told the ground truth, if somebody is."""
    return [f"{which} is {line}" for line in told(report.get("weights") or {})]


def _read(path: Path) -> dict[str, Any]:
    try:
        report = json.loads(path.read_text())
        complete = all({"seed", "solved"} <= entry.keys() for entry in report["episodes"])
        if complete and isinstance(report["played"], dict):  # else nobody knows whether two have the same levels
            return report
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    raise ValueError(f"{path}: no report with its episodes, expected what bringup/evaluate.py --json writes")


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    print(*compare(_read(options.first), _read(options.second)), sep="\n")
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
