"""Markdown tables of evaluations beside the paper's values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.paper.runs import Run, is_stale, load

STALE = " †"
"""Marks a result of other weights than those that ship now."""
MISSING = "-"


def configurations(runs: Sequence[Run]) -> str:
    """Return a table of success rates and rewards, ours beside the paper's."""
    header = ["configuration", "name", "oracles", "n", "success", "95 % interval", "paper", "reward (s.e.)", "paper"]
    return _table(header, [_row(run, load(run)) for run in runs])


def failures(runs: Sequence[Run]) -> str:
    """Return a table of how many episodes failed for which reason."""
    reports = [load(run) for run in runs]
    reasons = sorted({reason for report in reports if report for reason in report["failures"]})
    rows = [
        [run.title, *(str(report["failures"].get(reason, 0)) for reason in reasons)]
        for run, report in zip(runs, reports, strict=True)
        if report
    ]
    return _table(["configuration", *reasons], rows)


def test_uses(runs: Sequence[Run]) -> str:
    """Return how often the test levels were used for these rows, as their JSON has it."""
    uses = [report.get("test_uses") for report in map(load, runs) if report]
    counted = sum(len(entries) for entries in uses if entries)
    unknown = sum(entries is None for entries in uses)
    before = f"; {unknown} of the rows were measured before uses were counted" if unknown else ""
    return f"The test levels were used {counted} times for these rows{before}.\n"


def _row(run: Run, report: dict[str, Any] | None) -> list[str]:
    name, oracles = f"`{run.name}`", ", ".join(run.oracle) or "none"
    paper = [MISSING if run.paper_success is None else f"{100 * run.paper_success:.1f} %"]
    paper.append(MISSING if run.paper_reward is None else f"{run.paper_reward:.2f}")
    if report is None:
        return [run.title, name, oracles, "0", "not measured", MISSING, paper[0], MISSING, paper[1]]
    # A class of somebody's own that is told the truth counts as what it is.
    oracles = ", ".join(report.get("privileged", run.oracle)) or "none"
    returns = np.array([episode["return"] for episode in report["episodes"]])
    error = returns.std(ddof=1) / np.sqrt(len(returns)) if len(returns) > 1 else float("nan")
    low, high = report["success_interval"]
    return [
        run.title + (STALE if is_stale(report) else ""),
        name,
        oracles,
        str(len(returns)),
        f"{100 * report['success_rate']:.1f} %",
        f"{100 * low:.1f} to {100 * high:.1f} %",
        paper[0],
        f"{report['mean_return']:.2f} ({error:.2f})",
        paper[1],
    ]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
