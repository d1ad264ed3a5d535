"""Draw learning curves of runs: `python -m mujoban_planner.curves RUN... --names "MPO alone" ...`."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import matplotlib
import tyro

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from mujoban_core.files import check_file
from mujoban_core.program import read_options, run_command

PROG = "mujoban_planner.curves"

_DRC: Final = ((10e6, 0.34), (20e6, 0.81), (50e6, 0.93), (100e6, 0.96), (2e9, 0.99))
"""Moves of training and solve rate of DRC(3,3) on the unfiltered levels of Boxoban, by IMPALA (Guez et al. 2019)."""


@dataclass(frozen=True)
class Options:
    """Solve rate on held-out levels over samples and over CPU time.

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
    """Draw DRC(3,3) against its samples too, which are moves, on the unfiltered levels of Boxoban."""


def read_curve(run: Path, difficulty: int) -> list[tuple[float, float, float]]:
    """Return (samples, CPU seconds, solve rate) of each evaluation of a run.

    Raises:
        OSError: If the run has no metrics.
    """
    lines = (json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines())
    key = f"evaluation/success_rate/{difficulty}"
    return [(line["step"], line["cpu_seconds"], line[key]) for line in lines if key in line]


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
    draw(dict(zip(names, curves, strict=True)), options)
    return 0


def draw(curves: Mapping[str, Sequence[tuple[float, float, float]]], options: Options) -> None:
    """Draw the curves, each under its name, against samples and against CPU time."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for name, curve in curves.items():
        for axis, column, scale in ((axes[0], 0, 1e3), (axes[1], 1, 60.0)):
            axis.plot([point[column] / scale for point in curve], [point[2] for point in curve], ".-", label=name)
    if options.published:
        moves, rates = zip(*_DRC, strict=True)
        axes[0].plot([n / 1e3 for n in moves], rates, "x--", color="grey", label="DRC(3,3), published")
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
