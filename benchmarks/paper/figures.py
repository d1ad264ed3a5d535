"""Figures 2 and 4 of the paper, drawn from JSON; Figure 3 is in `benchmarks.paper.film`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from benchmarks.paper import runs as sources
from benchmarks.paper.baselines import AGAIN, BASELINES, KINDS, joined, points_of, solved_margins
from benchmarks.paper.curves import MODULES
from benchmarks.paper.runs import ResultError, Run, is_stale, load
from mujoban_core.grid import DIFFICULTIES
from mujoban_sim.presets import DEFAULT_WORLD

_COLUMNS: Final = 4
_MARKERS: Final = "s^v<>P*XdpH8"
"""Of rows of Table 1 in Figure 2, other than the stack's."""
_ASIDE: Final = 0.05
"""How far apart they stand there."""
_METHODS: Final = {"controller": "camera policy"}
"""What the curve of the weights that ship is called beside others."""
_VARIANTS: Final = {
    "mpo": "MPO alone, from nothing",
    "teacher": "its teacher",
    "two_cores": "from nothing, two cores",
}
"""Other ways to train a module, by the names of their files."""
_SAMPLES: Final = {"controller": "ticks played", "planner": "samples"}
"""What a module is trained on, in whose millions a curve is drawn; the others learn from recorded ticks."""


def difficulty(alone: Sequence[Run], ahead: Sequence[Run], file: Path) -> bool:
    """Draw success against difficulty (paper Fig. 2); return False when nothing has been measured.

    Args:
        alone: By the planner's policy alone.
        ahead: By default, with its search ahead.
        file: The image.
    """
    measured_alone, measured_ahead = _measured(alone), _measured(ahead)
    if not (measured_alone or measured_ahead):
        return False
    figure, axes = plt.subplots(figsize=(10, 4.2), layout="constrained")
    learned = f"all four modules learned, {DEFAULT_WORLD} world,\n"
    draw_rates(axes, measured_alone, f"{learned}the planner's policy alone", "tab:blue", "o", 0.0)
    draw_rates(axes, measured_ahead, f"{learned}the default, with the search ahead", "tab:orange", "D", 0.08)
    _draw_agents(axes)
    shown = (*measured_alone, *measured_ahead)
    paper = {(run.difficulty, run.paper_success) for run, _ in shown if run.paper_success is not None}
    if paper:
        axes.scatter(*zip(*paper, strict=True), marker="x", color="black", label="paper, its world", zorder=3)
    save_rates(figure, axes, file)
    return True


def _draw_agents(axes: Axes) -> None:
    """Draw the rows of Table 1, side by side, as many of them are alike, and each with a marker of its own."""
    # The first four colours are the stack's two, dark and pale.
    axes.set_prop_cycle(color=plt.get_cmap("tab20").colors[4:])  # pyright: ignore[reportAttributeAccessIssue]
    found = [(row.label, _measured([row.run(d) for d in DIFFICULTIES])) for row in BASELINES]
    drawn = [(label, measured) for label, measured in found if measured]
    for i, ((label, measured), marker) in enumerate(zip(drawn, cycle(_MARKERS), strict=False)):
        rates = [report["success_rate"] for _, report in measured]
        bars = list(zip(*(margins(report) for _, report in measured), strict=True))
        x = [run.difficulty + _ASIDE * (i - (len(drawn) - 1) / 2) for run, _ in measured]
        axes.errorbar(x, rates, yerr=bars, capsize=2, marker=marker, markersize=5, linewidth=1, label=label)


def _measured(runs: Sequence[Run]) -> list[tuple[Run, dict[str, Any]]]:
    """Return evaluations that have been run, with their reports."""
    return [(run, report) for run in runs if (report := load(run)) is not None]


def draw_rates(
    axes: Axes, reports: Sequence[tuple[Run, dict[str, Any]]], label: str, colour: str, marker: str, aside: float
) -> None:
    """Draw a curve of rates, a little aside as some are alike; hollow points, not joined, are of other weights."""
    for stale in (False, True):
        chosen = [(run, report) for run, report in reports if is_stale(report, run) == stale]
        if not chosen:
            continue
        x = [run.difficulty + aside for run, _ in chosen]
        y = [report["success_rate"] for _, report in chosen]
        low, high = zip(*(margins(report) for _, report in chosen), strict=True)
        axes.errorbar(
            x, y, yerr=[low, high], capsize=3, marker=marker, color=colour,
            label=f"{label},\nother weights than ship now" if stale else label,
            linestyle="none" if stale else "-", markerfacecolor="white" if stale else colour,
        )  # fmt: skip


def save_rates(figure: Figure, axes: Axes, file: Path) -> None:
    """Name the axes and bars of success against difficulty, write the figure and close it."""
    lowest = max(0.0, math.floor(10.0 * axes.dataLim.y0) / 10.0 - 0.1)
    axes.set(xlabel="difficulty", ylabel="success rate", ylim=(lowest, 1.0 + 0.02 * (1.0 - lowest)), xticks=range(1, 6))
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:.4g} %")
    axes.grid(alpha=0.3)
    title = "bars: 95 % intervals (Wilson)"
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", title=title, title_fontsize="small")
    figure.savefig(file, dpi=120)
    plt.close(figure)


def baseline_curves(file: Path) -> bool:
    """Draw success and return of the baselines in training against steps; return False when there is no curve.

    Of the modular row there is what it cost alone: none of its modules plays whole levels while it is trained. Bars
    of success are 95 % Wilson intervals.
    """
    rows = ((row, points_of(row)) for row in (*BASELINES, *AGAIN))
    found = [(row, points) for row, points in rows if any(point["solved"] for point in points)]
    if not found:
        return False
    figure, panels = plt.subplots(
        len(KINDS), len(DIFFICULTIES), figsize=(14, 5), layout="constrained", sharex=True, sharey="row"
    )
    for kind, line in zip(KINDS, panels, strict=True):
        for axes, d in zip(line, DIFFICULTIES, strict=True):
            for row, points in found:
                steps, means = np.reshape(joined(points, kind, d), (-1, 2)).T
                bars = np.reshape(solved_margins(points, d), (-1, 2)).T if kind == "solved" else None
                axes.errorbar(steps / 1e6, means, yerr=bars, capsize=2, marker=".", markersize=4, label=row.label)
            axes.grid(alpha=0.3)
        line[0].set(ylabel=kind, ylim=(0.0, None))
    for axes, d in zip(panels[0], DIFFICULTIES, strict=True):
        axes.set_title(f"difficulty {d}")
        axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:.4g} %")
    for axes in panels[1]:
        axes.set_xlabel("million environment steps")
    handles = {name: h for axes in panels.flat for h, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize="small")
    figure.savefig(file, dpi=110)
    plt.close(figure)
    return True


def curves(file: Path) -> list[str]:
    """Draw the learning curves of the modules (paper Fig. 4) that there are; return the modules without one.

    Beside the training of the weights that ship stand the variants of a module, such as MPO alone.

    Raises:
        ResultError: If a curve is not what `benchmarks.paper.curves` writes.
    """
    files = {module: sources.JSON / f"curve_{module}.jsonl" for module in MODULES}
    found = {module: _points(source) for module, source in files.items() if source.exists()}
    if found:
        figure, panels = plt.subplots(1, _COLUMNS, figsize=(3.0 * _COLUMNS, 2.7), layout="constrained", squeeze=False)
        for axes in panels[0][len(found) :]:
            axes.set_axis_off()
        for axes, (module, points) in zip(panels[0], found.items(), strict=False):
            prefix = f"curve_{module}_"
            others = {f.stem.removeprefix(prefix): _points(f) for f in sorted(sources.JSON.glob(f"{prefix}*.jsonl"))}
            variants = {_VARIANTS.get(name, name.replace("_", " ")): curve for name, curve in others.items()}
            for name, curve in {_METHODS.get(module, "what ships"): points, **variants}.items():
                steps, values = [p["step"] / 1e6 for p in curve], [p["value"] for p in curve]
                axes.plot(steps, values, marker=".", markersize=3, label=name)
            what = {p["what"] for curve in (points, *others.values()) for p in curve}
            if len(what) > 1:
                raise ResultError(f"{files[module]}: expected curves of one measure, not of {', '.join(sorted(what))}")
            if others:
                axes.legend(fontsize="small", loc="lower right")
            axes.set(title=module, xlabel=f"million {_SAMPLES.get(module, 'recorded ticks')}")
            _name_values(axes, points[0]["what"])
            axes.grid(alpha=0.3)
        figure.savefig(file, dpi=110)
        plt.close(figure)
    return [module for module in MODULES if module not in found]


def _name_values(axes: Axes, what: str) -> None:
    """Say what a curve is of: a rate in percent, or a loss, of which the last part is not to vanish under the first."""
    if not what.startswith("loss"):
        axes.set_ylabel(what)
        axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:.4g} %")
        return
    axes.set(ylabel=f"{what}\n[nats a tick, less is better]", yscale="log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def margins(report: dict[str, Any]) -> tuple[float, float]:
    """Return how far the interval of an evaluation's success rate reaches below and above it."""
    low, high = report["success_interval"]
    return report["success_rate"] - low, high - report["success_rate"]


def _points(source: Path) -> list[dict[str, Any]]:
    try:
        points = [json.loads(line) for line in source.read_text().splitlines()]
        if points and all({"step", "value", "what"} <= point.keys() for point in points):
            return points
    except (json.JSONDecodeError, AttributeError):
        pass
    raise ResultError(f"{source}: expected lines with step, value and what; rerun python -m benchmarks.paper.curves")
