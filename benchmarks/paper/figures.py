"""Figures 2 and 4 of the paper, drawn from JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.paper.runs import JSON, Run, load

CURVES: Final = {
    "controller": ("curve_controller.jsonl", "instructions completed"),
    "planner": ("curve_planner.jsonl", "levels solved"),
    "estimator": ("curve_estimator.jsonl", "cells right"),
    "termination": ("curve_termination.jsonl", "F1"),
}
"""Module -> its curve, one JSON object a line with `step` and `value`, and what `value` is (paper Fig. 4)."""


def difficulty(runs: Sequence[Run], file: Path) -> bool:
    """Draw success against difficulty (paper Fig. 2); return False when nothing has been measured."""
    reports = [(run, report) for run in runs if (report := load(run)) is not None]
    if not reports:
        return False
    x = [run.difficulty for run, _ in reports]
    y = [report["success_rate"] for _, report in reports]
    low = [rate - report["success_interval"][0] for rate, (_, report) in zip(y, reports, strict=True)]
    high = [report["success_interval"][1] - rate for rate, (_, report) in zip(y, reports, strict=True)]
    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    axes.errorbar(x, y, yerr=[low, high], marker="o", capsize=3, label="Mujoban, fully learned")
    paper = [(run.difficulty, run.paper_success) for run, _ in reports if run.paper_success is not None]
    if paper:
        axes.scatter(*zip(*paper, strict=True), marker="x", color="black", label="paper, Table 1", zorder=3)
    axes.set(xlabel="difficulty", ylabel="success rate", ylim=(0, 1.02), xticks=range(1, 6))
    axes.legend(loc="lower left")
    figure.savefig(file, dpi=120)
    plt.close(figure)
    return True


def curves(file: Path, folder: Path = JSON) -> bool:
    """Draw the learning curves of the modules (paper Fig. 4); return False when there is none."""
    found = {name: (folder / source, label) for name, (source, label) in CURVES.items() if (folder / source).exists()}
    if not found:
        return False
    figure, panels = plt.subplots(1, len(found), figsize=(3.2 * len(found), 2.8), layout="constrained", squeeze=False)
    for axes, (name, (source, label)) in zip(panels[0], found.items(), strict=True):
        points = [json.loads(line) for line in source.read_text().splitlines()]
        axes.plot([p["step"] for p in points], [p["value"] for p in points])
        axes.set(title=name, xlabel="environment steps or samples", ylabel=label)
    figure.savefig(file, dpi=120)
    plt.close(figure)
    return True
