"""Draw learning curves of runs and print them as tables: `... mujoban_planner.curves RUN... --names "MPO alone" ...`.

Shapes: P evaluations of a run.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from mujoban_core.files import check_file
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_positive

PROG = "mujoban_planner.curves"

Curve: TypeAlias = Sequence[tuple[float, float]]
"""Cost and solve rate of evaluations in the order of cost, [P]."""

_PUBLISHED: Final = "DRC(3,3), published"

_DRC: Final = ((10e6, 0.34), (20e6, 0.81), (50e6, 0.93), (100e6, 0.96), (2e9, 0.99))
"""Moves of training and solve rate of DRC(3,3) on the unfiltered levels of Boxoban, by IMPALA (Guez et al. 2019)."""


@dataclass(frozen=True)
class Options:
    """Solve rate on held-out levels over samples and over CPU time: a picture, and tables on standard output, Markdown.

    The tables have rows of equal samples and of equal CPU minutes, linear between the evaluations of a run, and blank
    before its first and after its last one.

    A sample is a labelled state (imitation), an instruction (MPO), a push (PPO and MPO over pushes) or a network
    evaluation of a search (expert iteration).
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run directories."""
    names: tuple[str, ...] = ()
    """What each run is, for the legend; its folder's name where nothing is given."""
    out: Path = Path("planner_curve.png")
    """Image to write."""
    difficulty: int = 5
    """Difficulty whose solve rate is drawn."""
    published: bool = False
    """Show DRC(3,3) against its samples too, which are moves, on the unfiltered levels of Boxoban."""
    every_samples: int = 100_000
    """Samples from one row of the table to the next."""
    every_minutes: float = 10.0
    """CPU minutes from one row of the table to the next."""

    def __post_init__(self) -> None:
        """Reject rows that get nowhere."""
        check_counts(self, "every_samples")
        check_positive(self, "every_minutes")


def read_curve(run: Path, difficulty: int) -> list[tuple[float, float, float]]:
    """Return (samples, CPU seconds, solve rate) of each evaluation of a run.

    Raises:
        OSError: If the run has no metrics.
    """
    key = f"evaluation/success_rate/{difficulty}"
    curve: list[tuple[float, float, float]] = []
    for line in map(json.loads, (run / "metrics.jsonl").read_text().splitlines()):
        samples, cpu_seconds = line["step"], line["cpu_seconds"]
        # A run that was killed went on from its last checkpoint: what it had come to after that was lost.
        while curve and (curve[-1][0] > samples or curve[-1][1] > cpu_seconds):
            curve.pop()
        if key in line:
            curve.append((samples, cpu_seconds, line[key]))
    return curve


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    names = options.names or tuple(run.name for run in options.runs)
    check_file("--out", options.out)
    try:
        curves = [read_curve(run, options.difficulty) for run in options.runs]
    except OSError as error:
        raise ValueError(f"{error.filename}: expected the metrics of a trainer's run directory") from error
    if len(names) != len(curves):
        raise ValueError(f"--names: {len(names)} names, expected one for each of the {len(curves)} runs")
    if len(set(names)) != len(names):
        raise ValueError(f"--names: {', '.join(names)}, expected another name for each run")
    named = dict(zip(names, curves, strict=True))
    draw(named, options)
    print(tables(named, options))
    return 0


def tables(curves: Mapping[str, Sequence[tuple[float, float, float]]], options: Options) -> str:
    """Return the solve rates of curves, each under its name, at equal samples and at equal CPU time, in Markdown."""
    by_samples = {name: [(samples, rate) for samples, _, rate in curve] for name, curve in curves.items()}
    by_minutes = {name: [(seconds / 60.0, rate) for _, seconds, rate in curve] for name, curve in curves.items()}
    samples, minutes = _costs(by_samples, options.every_samples), _costs(by_minutes, options.every_minutes)
    if options.published:
        by_samples[_PUBLISHED] = list(_DRC)
        samples = sorted({*samples, *(cost for cost, _ in _DRC)})
    return "\n\n".join(
        (
            f"Success rate, difficulty {options.difficulty}, linear between evaluations",
            _table("samples", samples, by_samples),
            _table("CPU minutes", minutes, by_minutes),
        )
    )


def _costs(curves: Mapping[str, Curve], every: float) -> list[float]:
    """Return the multiples of a cost up to the last evaluation of all curves."""
    last = max((curve[-1][0] for curve in curves.values() if curve), default=0.0)
    return [every * (i + 1) for i in range(int(last / every))]


def _table(unit: str, costs: Sequence[float], curves: Mapping[str, Curve]) -> str:
    """Return a row for each cost at which a curve has a solve rate, with a column for each curve."""
    rows = [[f"{cost:,.12g}", *(_rate_at(curve, cost) for curve in curves.values())] for cost in costs]
    lines = [[unit, *curves], ["---:"] * (len(curves) + 1), *(row for row in rows if any(row[1:]))]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _rate_at(curve: Curve, cost: float) -> str:
    """Return the solve rate at a cost, linear between evaluations; nothing before the first or after the last one."""
    if not curve or not curve[0][0] <= cost <= curve[-1][0]:
        return ""
    costs, rates = zip(*curve, strict=True)
    return f"{100.0 * np.interp(cost, costs, rates):.1f} %"


def draw(curves: Mapping[str, Sequence[tuple[float, float, float]]], options: Options) -> None:
    """Draw the curves, each under its name, against samples and against CPU time."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for name, curve in curves.items():
        for axis, column, scale in ((axes[0], 0, 1e3), (axes[1], 1, 60.0)):
            axis.plot([point[column] / scale for point in curve], [point[2] for point in curve], ".-", label=name)
    if options.published:
        moves, rates = zip(*_DRC, strict=True)
        axes[0].plot([n / 1e3 for n in moves], rates, "x--", color="grey", label=_PUBLISHED)
    axes[0].set(xlabel="thousand samples (logarithmic)", xscale="log")
    axes[0].set_ylabel(f"success rate, difficulty {options.difficulty}")
    axes[1].set(xlabel="CPU minutes of training")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.set_ylim(0.0, 1.02)
    axes[0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(options.out, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    run_command(PROG, main)
