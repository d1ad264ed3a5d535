"""Figure 4: learning curves of the modules, from the `metrics.jsonl` that trainers write in their run directories.

    python -m benchmarks.paper.curves --planner runs/planner --estimator runs/estimator --controller runs/a runs/b

writes one `curve_<module>.jsonl` for each module named, an object a line with `step`, `value` and `what` the value is.
Several runs of a module are joined in the order given, as when a run starts from the weights of another; `--append`
goes on after the points that the file has. `--variant mpo` writes `curve_<module>_mpo.jsonl`, a curve to draw beside.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks.paper.runs import JSON, ResultError
from mujoban_core.files import write_atomically
from mujoban_core.program import read_options, run_command
from mujoban_rl import metrics

MODULES: Final = ("controller", "planner", "estimator", "termination")
_FEWEST: Final = 3
"""Points that make a curve; a measure with fewer gives way to the next."""
_MOST: Final = 60
"""Points of a curve; more are averaged."""


class Measure(NamedTuple):
    """Something that is drawn of a run."""

    keys: tuple[str, ...]
    """Entries of a line of the metrics; several are averaged by their counts, `<key>_n`."""
    what: str


MEASURES: Final = {
    "controller": (Measure(("instruction/move", "instruction/push"), "moves and pushes completed"),),
    "planner": (
        Measure(("evaluation/success_rate/5",), "levels of difficulty 5 solved"),
        Measure(("train/accuracy",), "decisions right"),
    ),
    "estimator": (
        Measure(("evaluation/box_recall_in_view",), "boxes in view found"),
        Measure(("train/box",), "loss of the box layer"),
    ),
    "termination": (Measure(("train/beta",), "loss of beta"),),
}
"""What is drawn of each module: success or accuracy as in the paper, and the next one where a run has too few of it. Of
the termination it is the loss: no recording that the weights that ship were judged on counts what ends late."""


PROG: Final = "benchmarks.paper.curves"


@dataclass(frozen=True)
class Options:
    """Run directories of each module."""

    controller: tuple[Path, ...] = ()
    planner: tuple[Path, ...] = ()
    estimator: tuple[Path, ...] = ()
    """Estimator and termination are trained together: name the run for both."""
    termination: tuple[Path, ...] = ()
    variant: str = ""
    """Name of another way to train, whose curve stands beside that of the weights that ship."""
    append: bool = False
    """Go on after the last point of the file, as where the metrics of earlier runs are lost."""
    out: Path = JSON


def read_curve(module: str, runs: Sequence[Path], offset: float = 0.0) -> list[dict[str, Any]]:
    """Return the points of a module's curve over one or more runs, after `offset` samples of those before.

    Raises:
        ResultError: If a run has no metrics, or nothing of what is drawn.
    """
    lines: list[tuple[float, dict[str, Any]]] = []
    for run in runs:
        lines += [(offset + line["step"], line) for line in read_metrics(run)]
        offset = lines[-1][0] if lines else offset
    for measure in MEASURES[module]:
        values = [(step, metrics.mean_of([line], measure.keys)) for step, line in lines]
        points = [(step, *value) for step, value in values if value is not None]
        if len(points) >= _FEWEST:
            return [{"step": round(step), "value": value, "what": measure.what} for step, value in _thin(points)]
    wanted = ", ".join(key for measure in MEASURES[module] for key in measure.keys)
    raise ResultError(f"{', '.join(map(str, runs))}: fewer than {_FEWEST} points of {wanted}")


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return what a trainer has written into `metrics.jsonl`.

    Raises:
        ResultError: If that is missing or damaged.
    """
    try:
        return metrics.read_metrics(run)
    except ValueError as error:
        raise ResultError(str(error)) from error


def _thin(points: Sequence[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Return at most `_MOST` points (step, value), each the mean over the counts in its stretch."""
    stretches = np.array_split(np.array(points), min(len(points), _MOST))
    return [(float(part[-1, 0]), round(float(np.average(part[:, 1], weights=part[:, 2])), 5)) for part in stretches]


def write(options: Options) -> None:
    """Write the curves of the modules whose runs are named."""
    for module in MODULES:
        runs: tuple[Path, ...] = getattr(options, module)
        if not runs:
            continue
        file = options.out / ("_".join(filter(None, ("curve", module, options.variant))) + ".jsonl")
        before = file.read_text() if options.append else ""
        last = json.loads(before.splitlines()[-1])["step"] if before else 0.0
        points = read_curve(module, runs, last)
        write_atomically(file, (before + "".join(json.dumps(point) + "\n" for point in points)).encode())
        print(f"{file.name}: {len(points)} points of {points[0]['what']!r}")


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    write(read_options(Options, command_line, PROG, __doc__))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
