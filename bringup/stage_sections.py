"""Sections of the report of `bringup.train_all` about single stages: what each measured last, and its curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from mujoban_core.text import readable
from mujoban_rl.metrics import COUNT

_LEARNING: Final = (
    "loss/", "train/", "mpo/loss", "mpo/policy_loss", "mpo/q", "play/", "search/", "instruction/", "return",
    "reward",
)  # fmt: skip
"""How the names of losses, and of what play in training brings, begin."""
_CLOCKS: Final = ("time", "seconds", "cpu_seconds")
_COLUMNS: Final = 4
"""Panels side by side."""


Measured = Mapping[str, list[dict[str, Any]]]
"""The lines of the metrics of each stage that has any, by the stage's name."""


def sections(run: Path, names: Mapping[str, str], measured: Measured) -> Iterator[str]:
    """Yield the lines of a section, folded up, for each stage that has measured something; draw `curves/STAGE.png`.

    Args:
        run: Directory of the run, with those of its stages.
        names: Titles of the stages, by name.
        measured: By the stages.
    """
    for name, title in names.items():
        if name not in measured:
            continue
        lines = measured[name]
        yield from ("", f"<details><summary>{title}</summary>", "")
        picture = Path("curves") / f"{name}.png"
        if draw_learning(lines, title, run / picture):
            yield from (f"![{title}: losses, and what play brought, against CPU seconds]({picture})", "")
        yield from ("| measured last | value |", "|---|---|")
        yield from (f"| {metric} | {readable(value)} |" for metric, value in last_values(lines).items())
        yield from ("", "</details>")


def last_values(lines: list[dict[str, Any]]) -> dict[str, float]:
    """Return the last value of each metric in the lines of a training, by name."""
    found = {
        metric: value
        for line in lines
        for metric, value in line.items()
        if value is not None and metric not in _CLOCKS and not metric.endswith(COUNT)
    }
    return dict(sorted(found.items()))


def draw_learning(lines: list[dict[str, Any]], title: str, path: Path) -> bool:
    """Draw losses and returns of a training against its CPU seconds, a panel each; return whether there are any."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for line in lines:
        for metric, value in line.items():
            if metric.startswith(_LEARNING) and not metric.endswith(COUNT) and value is not None:
                curves.setdefault(metric, []).append((line["cpu_seconds"], value))
    curves = {metric: points for metric, points in curves.items() if len(points) > 1}
    if not curves:
        return False
    columns = min(len(curves), _COLUMNS)
    rows = -(-len(curves) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(2.7 * columns, 1.9 * rows), squeeze=False, sharex=True)
    for axis in axes.flat[len(curves) :]:
        axis.remove()
    for axis, (metric, points) in zip(axes.flat, curves.items(), strict=False):
        axis.plot(*zip(*points, strict=True), linewidth=1.0)
        axis.set_title(metric, fontsize=8)
        axis.tick_params(labelsize=7)
    figure.suptitle(f"{title}, against CPU seconds", fontsize=9)
    figure.tight_layout()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return True
