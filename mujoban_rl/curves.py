"""Draw learning curves of any runs and print them as tables: `... mujoban_rl.curves RUN... --metric KEY`.

Shapes: P evaluations of a run.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, NamedTuple, TypeAlias

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from mujoban_core.files import check_file
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_positive
from mujoban_rl.metrics import read_metrics

PROG = "mujoban_rl.curves"

Curve: TypeAlias = Sequence[tuple[float, float]]
"""Cost and value of evaluations in the order of cost, [P]."""

_JUDGED: Final = "evaluation/"
_RATES: Final = ("rate", "success", "solved", "accuracy", "instruction/")
"""One of them is in the name of a metric that is a share."""


class Point(NamedTuple):
    """An evaluation of a run."""

    samples: float
    cpu_seconds: float
    value: float


@dataclass(frozen=True)
class CurveOptions:
    """Which curves are drawn."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run directories, at least one."""
    names: tuple[str, ...] = ()
    """What each run is, for the legend; its folder's name where nothing is given."""
    out: Path = Path("curve.png")
    """Image to write."""
    every_samples: int = 100_000
    """Samples from one row of the table to the next."""
    every_minutes: float = 10.0
    """CPU minutes from one row of the table to the next."""

    def __post_init__(self) -> None:
        """Reject nothing to draw, and rows that get nowhere."""
        if not self.runs:
            raise ValueError("no run is named, expected run directories")
        check_counts(self, "every_samples")
        check_positive(self, "every_minutes")


@dataclass(frozen=True)
class Options(CurveOptions):
    """A metric over samples and over CPU time: a picture, and tables on standard output, Markdown.

    The tables have rows of equal samples and of equal CPU minutes, linear between the points of a run, and blank
    before its first and after its last one.

    A sample is what a run counts as its steps: one of the environment (controller and agents), a recorded tick
    (estimator), or what `mujoban_planner.curves --help` says (planner).
    """

    metric: str = "evaluation/success_rate"
    """Key of the lines of metrics.jsonl."""
    what: str = ""
    """What it is, for axis and tables; its key by default."""


class Chart(NamedTuple):
    """What is drawn and printed."""

    curves: dict[str, list[Point]]
    """By the names of the runs."""
    what: str
    """What their values are."""
    rate: bool
    """Whether they are shares."""
    beside: Mapping[str, Curve]
    """Curves whose cost is known in samples alone."""


def read_curve(run: Path, metric: str) -> list[Point]:
    """Return the points of a run at which a metric was written.

    Raises:
        ValueError: If the run has no metrics.
    """
    lines = read_metrics(run)
    return [Point(line["step"], line["cpu_seconds"], line[metric]) for line in lines if line.get(metric) is not None]


def read_chart(
    options: CurveOptions, metric: str, what: str = "", beside: Mapping[str, Curve] | None = None
) -> Chart:
    """Return a metric of all runs under its own name or another.

    Raises:
        ValueError: If a run has no metrics, none has this one, or names are not one for each run.
    """
    names = options.names or tuple(run.name for run in options.runs)
    check_file("--out", options.out)
    if len(names) != len(options.runs):
        raise ValueError(f"--names: {len(names)} names, expected one for each of the {len(options.runs)} runs")
    if len(set(names)) != len(names):
        raise ValueError(f"--names: {', '.join(names)}, expected another name for each run")
    curves = {name: read_curve(run, metric) for name, run in zip(names, options.runs, strict=True)}
    if options.runs and not any(curves.values()):
        there = ", ".join(_metrics(options.runs))
        raise ValueError(f"{metric}: in none of the runs, expected a metric of theirs, such as {there}")
    said = what or metric.removeprefix(_JUDGED).replace("_", " ").replace("/", ", ")
    return Chart(curves, said, any(word in metric for word in _RATES), beside or {})


def _metrics(runs: Sequence[Path]) -> list[str]:
    """Return the names of what evaluations have found, or else of all metrics."""
    found = sorted({key for run in runs for line in read_metrics(run) for key in line})
    return [key for key in found if key.startswith(_JUDGED)] or found


def show(chart: Chart, options: CurveOptions) -> None:
    """Write the picture and print the tables."""
    draw(chart, options.out)
    print(tables(chart, options))


def tables(chart: Chart, options: CurveOptions) -> str:
    """Return the values of curves, each under its name, at equal samples and at equal CPU time, in Markdown."""
    by_samples: dict[str, Curve] = {n: [(p.samples, p.value) for p in c] for n, c in chart.curves.items()}
    by_minutes: dict[str, Curve] = {n: [(p.cpu_seconds / 60.0, p.value) for p in c] for n, c in chart.curves.items()}
    samples, minutes = _costs(by_samples, options.every_samples), _costs(by_minutes, options.every_minutes)
    samples = sorted({*samples, *(cost for curve in chart.beside.values() for cost, _ in curve)})
    return "\n\n".join(
        (
            f"{chart.what[:1].upper()}{chart.what[1:]}, linear between evaluations",
            _table("samples", samples, {**by_samples, **chart.beside}, rate=chart.rate),
            _table("CPU minutes", minutes, by_minutes, rate=chart.rate),
        )
    )


def _costs(curves: Mapping[str, Curve], every: float) -> list[float]:
    """Return the multiples of a cost up to the last evaluation of all curves."""
    last = max((curve[-1][0] for curve in curves.values() if curve), default=0.0)
    return [every * (i + 1) for i in range(int(last / every))]


def _table(unit: str, costs: Sequence[float], curves: Mapping[str, Curve], *, rate: bool) -> str:
    """Return a row for each cost at which a curve has a value, with a column for each curve; or that there is none."""
    rows = [[f"{cost:,.12g}", *(_value_at(curve, cost, rate=rate) for curve in curves.values())] for cost in costs]
    shown = [row for row in rows if any(row[1:])]
    if not shown:
        option = f"--every-{unit.split()[-1]}"
        return f"No run has evaluations before and after a row of {unit}: {option} takes smaller steps."
    lines = [[unit, *curves], ["---:"] * (len(curves) + 1), *shown]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _value_at(curve: Curve, cost: float, *, rate: bool) -> str:
    """Return the value at a cost, linear between evaluations; nothing before the first or after the last one."""
    if not curve or not curve[0][0] <= cost <= curve[-1][0]:
        return ""
    costs, values = zip(*curve, strict=True)
    value = float(np.interp(cost, costs, values))
    return f"{100.0 * value:.1f} %" if rate else f"{value:.4g}"


def draw(chart: Chart, out: Path) -> None:
    """Draw the curves, each under its name, against samples and against CPU time."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for name, curve in chart.curves.items():
        values = [point.value for point in curve]
        axes[0].plot([point.samples / 1e3 for point in curve], values, ".-", label=name)
        axes[1].plot([point.cpu_seconds / 60.0 for point in curve], values, ".-", label=name)
    for name, curve in chart.beside.items():
        samples, values = zip(*curve, strict=True)
        axes[0].plot([n / 1e3 for n in samples], values, "x--", color="grey", label=name)
    axes[0].set(xlabel="thousand samples (logarithmic)", xscale="log")
    axes[0].set_ylabel(chart.what)
    axes[1].set(xlabel="CPU minutes of training")
    for axis in axes:
        axis.grid(alpha=0.3)
        if chart.rate:
            axis.set_ylim(0.0, 1.02)
    if chart.rate:
        axes[0].yaxis.set_major_formatter(lambda y, _: f"{100 * y:.4g} %")
    axes[0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    show(read_chart(options, options.metric, options.what), options)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
