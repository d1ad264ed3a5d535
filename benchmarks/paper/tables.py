"""Markdown tables of evaluations beside the paper's values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from benchmarks.paper.baselines import AGAIN, BASELINES, JOINT, MODULAR, ORIGINS, Baseline, points_of
from benchmarks.paper.runs import DIFFICULTY, POLICY_ALONE, Run, distinct, is_stale, load
from bringup.results import Failure
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.plugins import ROLES
from mujoban_core.reports import count_uses
from mujoban_core.stats import paired_difference

STALE = " †"
"""Marks a result of other weights than those that ship now."""
MISSING = "-"
NOT_MEASURED: Final = "not measured"
MODULAR_LEVELS = (
    "all difficulties; its own search, a teacher, rules that look around ([model cards](../models/))"
)
"""What the modules that ship learned from, where the other rows have reward alone."""
_SAID: Final = {
    "vtrace": '"less than 30%" solved (section 3)',
    "structured": '"significantly better" than V-trace, "slightly below the modular approach" (section 3)',
}
"""What the paper's text says of the success of a row of Table 1, by the row's name."""


def configurations(runs: Sequence[Run]) -> str:
    """Return a table of success rates and rewards, ours beside the paper's."""
    header = ["configuration", "name", "oracles", "n", "success", "95 % interval", "paper", "reward (s.e.)", "paper"]
    return _table(header, [_row(run, load(run)) for run in runs])


def failures(runs: Sequence[Run]) -> str:
    """Return a table of how many episodes failed for which reason, and a line that says what the reasons mean.

    Like every table it names who was told the ground truth.
    """
    reports = [load(run) for run in runs]
    reasons = sorted({reason for report in reports if report for reason in report["failures"]})
    rows = [
        [
            run.title + _mark(run, report),
            privileged(run, report),
            *(str(report["failures"].get(reason, 0)) for reason in reasons),
        ]
        for run, report in zip(runs, reports, strict=True)
        if report
    ]
    meant = "; ".join(f"*{reason}*, {Failure(reason).meaning}" for reason in reasons)
    return _table(["configuration", "oracles", *reasons], rows) + (f"\nCauses: {meant}.\n" if meant else "")


def fine_tuned() -> str:
    """Return why the stack fails before it is fine-tuned as a whole and after, and what it gained; nothing until noted.

    What is compared is the fine-tuned stack and that from which it came: where the row before was played with other
    weights than those from which the tuning began, as the run that was noted says, a line says that they are not.
    """
    before, after = POLICY_ALONE[0], JOINT.run(POLICY_ALONE[0].difficulty)
    reports, points = (load(before), load(after)), points_of(JOINT)
    began = points[-1].get(ORIGINS) if points else None
    if None in reports or began is None:
        return ""
    played, tuned = (report["weights"] for report in reports if report)
    kept = ROLES.keys() - dict(after.modules)
    others = [r for r in ROLES if played.get(r) != began[r] or (r in kept and tuned.get(r) != began[r])]
    if others:
        return (
            f"*{before.title}* and *{after.title}* are not compared: they did not play with the weights with which the "
            f"fine-tuning began, by the digests of {', '.join(others)}.\n"
        )
    head = f"Why episodes of difficulty {before.difficulty} fail, before fine-tuning as a whole and after:\n\n"
    return head + failures((before, after)) + _gained(*(report for report in reports if report))


def _gained(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Return in a sentence by how much success after fine-tuning differs on the levels that were played before, too."""
    (lost, won), levels = _solved_alone(before, after)
    if not levels:
        return ""
    mean, low, high = (100 * value for value in paired_difference(len(lost), len(won), len(levels)))
    return (
        f"\nFine-tuned less before, on the same {len(levels)} levels: {mean:+.1f} points of success (95 % interval "
        f"{low:+.1f} to {high:+.1f}); solved before alone: {len(lost)}, after alone: {len(won)}.\n"
    )


def privileged(run: Run, report: dict[str, Any]) -> str:
    """Return which roles were told the ground truth in an evaluation of a run: oracles, and teachers of bodies."""
    return ", ".join(report.get("privileged", run.oracle)) or "none"


def differences(one: Run, other: Run) -> str:
    """Return which levels ended otherwise in one run than in another, and why; nothing while one is missing."""
    reports = [load(run) for run in (one, other)]
    if None in reports:
        return ""
    told = [report for report in reports if report]
    only, shared = _solved_alone(*told)
    lost = [{e["seed"]: e["failure"] for e in report["episodes"]} for report in reversed(told)]
    named = [
        ", ".join(f"{seed} ({causes[seed]})" for seed in seeds) or "none"
        for seeds, causes in zip(only, lost, strict=True)
    ]
    weights = [report["weights"] for report in told]
    apart = sorted(dict(weights[0].items() ^ weights[1].items()))
    why = (
        f"They were played with other weights: {', '.join(apart)}."
        if apart
        else "Networks see batches of other sizes there, which changes the last bits of their answers, and with them "
        "now and then a decision."
    )
    return (
        f"Of {len(shared)} levels, solved by `{one.name}` alone: {named[0]}; by `{other.name}` alone: {named[1]} "
        f"(seeds, and what the other lost them by). {why}\n"
    )


def _solved_alone(one: dict[str, Any], other: dict[str, Any]) -> tuple[list[list[int]], list[int]]:
    """Return the seeds that either report alone solved, of the one and of the other, and those that both played."""
    first, second = ({e["seed"]: e["solved"] for e in report["episodes"]} for report in (one, other))
    shared = sorted(first.keys() & second.keys())
    return [[seed for seed in shared if a[seed] and not b[seed]] for a, b in ((first, second), (second, first))], shared


def test_uses(runs: Iterable[Run], films: Iterable[dict[str, Any] | None]) -> str:
    """Return how often the test levels were used for rows and for film strips, as their JSON has it.

    Args:
        runs: Of the rows; one that comes twice counts once.
        films: Recorded episodes; None where there is none.
    """
    rows = [report for run in distinct(runs) if (report := load(run)) is not None]
    strips = [episode for episode in films if episode is not None]
    counts = [sum(count_uses(report.get("test_uses", [])) for report in kind) for kind in (rows, strips)]
    unknown = sum("test_uses" not in report for report in (*rows, *strips))
    before = f" {unknown} of them were measured before uses were noted." if unknown else ""
    return (
        f"For this page test levels were used {sum(counts)} times: {counts[0]} evaluations for {len(rows)} rows of its "
        f"tables, {counts[1]} recordings for {len(strips)} film strips.{before} Each is noted in `json/` with its "
        "code, weights and levels (`test_uses`); what was measured again, as with other weights, counts again.\n"
    )


def baselines() -> str:
    """Return Table 1: the modular stack and what it is compared with, what each was trained on and how long."""
    header = ["agent", "name", "sees", "trained on", "steps", "CPU hours", "wall-clock", "paper", "n"]
    header += [f"difficulty {d}" for d in DIFFICULTIES]
    rates = _rates(DIFFICULTY)
    title = "modular, as it ships, the planner's policy alone"
    rows = [[title, MISSING, "o_cam, o_pr, o_pos", MODULAR_LEVELS, *_cost([]), MODULAR.paper, *rates]]
    for row in (*BASELINES, *(again for again in AGAIN if points_of(again))):
        paper = "; ".join(filter(None, (row.paper, _SAID.get(row.name))))
        rates = _rates([row.run(d) for d in DIFFICULTIES])
        levels = f"{row.levels} ([how]({row.guide}))" if row.guide else row.levels
        rows.append([row.title, f"`{row.name}`", row.sees, levels, *_cost(points_of(row)), paper, *rates])
    return _table(header, rows)


def commands(rows: Sequence[Baseline], *before: str) -> str:
    """Return the commands that train rows of Table 1, after those that have to come before, as a block of code."""
    return "".join(f"    {line}\n" for line in (*before, *(c for row in rows for c in row.commands)))


def _cost(points: Sequence[dict[str, Any]]) -> list[str]:
    """Return steps, CPU hours and hours of wall-clock of a run, given its curve."""
    if not points:
        return [MISSING] * 3
    last = points[-1]
    return [f"{last['step'] / 1e6:.2f} M", *(f"{last[kind] / 3600:.1f}" for kind in ("cpu_seconds", "seconds"))]


def _rates(runs: Sequence[Run]) -> list[str]:
    """Return the number of levels, and success with its interval at each difficulty."""
    reports = [(run, load(run)) for run in runs]
    counts = {len(report["episodes"]) for _, report in reports if report}
    cells = []
    for run, report in reports:
        if report is None:
            cells.append(NOT_MEASURED)
            continue
        low, high = report["success_interval"]
        rate = f"{100 * report['success_rate']:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
        cells.append(rate + _mark(run, report))
    return ["/".join(map(str, sorted(counts))) or "0", *cells]


def _mark(run: Run, report: dict[str, Any]) -> str:
    """Return what follows a title or a number that was measured with other weights than those that ship now."""
    return STALE if is_stale(report, run) else ""


def _row(run: Run, report: dict[str, Any] | None) -> list[str]:
    name, oracles = f"`{run.name}`", ", ".join(run.oracle) or "none"
    paper = [MISSING if run.paper_success is None else f"{100 * run.paper_success:.1f} %"]
    paper.append(MISSING if run.paper_reward is None else f"{run.paper_reward:.2f}")
    if report is None:
        return [run.title, name, oracles, "0", NOT_MEASURED, MISSING, paper[0], MISSING, paper[1]]
    # A class of somebody's own that is told the truth counts as what it is.
    oracles = privileged(run, report)
    returns = np.array([episode["return"] for episode in report["episodes"]])
    error = returns.std(ddof=1) / np.sqrt(len(returns)) if len(returns) > 1 else float("nan")
    low, high = report["success_interval"]
    return [
        run.title + _mark(run, report),
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
