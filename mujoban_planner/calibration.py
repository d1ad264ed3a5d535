"""Whether pushes are deadly as often as the planner says: `python -m mujoban_planner.calibration [--bags DIR]`.

Draws a reliability diagram (DeGroot and Fienberg 1983): of the pushes to which the planner gave about the same
probability that no solution is left after them, the share of which that is true by the solver. With bags also for
the states as an estimator saw them, of which the truth is known.

Shapes: S samples, D = 4 directions, I = 8 rows and columns of the interior, X pushes, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.files import check_file
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts
from mujoban_core.reports import give_report
from mujoban_planner import SHIPPED, load
from mujoban_planner.bag_lessons import Lessons
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.samples import Samples, make_batch
from mujoban_planner.teacher import Teacher
from mujoban_planner.validation import validation_levels

matplotlib.use("Agg")
from matplotlib import pyplot as plt

PROG = "mujoban_planner.calibration"

_BINS: Final = 10
_CHUNK: Final = 512
"""States in one forward pass."""
_AREA: Final = 5.0
"""Of a point, for each factor e of the pushes behind it."""


@dataclass(frozen=True)
class Options:
    """Draw how often pushes are deadly against how probable the planner calls that."""

    bags: tuple[Path, ...] = ()
    """Recorded bags, or folders of bags, whose decisions to move are judged as they were estimated."""
    episodes: int = 500
    """Validation levels whose solutions are judged as they are."""
    difficulty: int = 5
    """Of these levels."""
    weights: Path = SHIPPED
    """Weights with their record."""
    out: Path = Path("planner_calibration.png")
    """Image to write."""
    json: Path | None = None
    """Where the figures are written."""

    def __post_init__(self) -> None:
        """Reject no levels."""
        check_counts(self, "episodes")


class Verdicts(NamedTuple):
    """Pushes whose outcome is known."""

    said: NDArray[np.float64]
    """Probability that a push is deadly, by the planner, [X]."""
    dead: NDArray[np.bool_]
    """Whether it is, [X]."""


@torch.inference_mode()
def verdicts(planner: LearnedPlanner, samples: Samples, states: NDArray[np.floating[Any]] | None = None) -> Verdicts:
    """Return what a planner says of all pushes whose outcome is known, from one view of the board.

    Args:
        planner: A network that judges pushes.
        samples: Labelled states, [S].
        states: What the planner sees of them, [S, N, N, 4]; by default the states as they are.

    Raises:
        ValueError: If the network does not judge pushes.
    """
    said, dead = [], []
    for first in range(0, len(samples.agent), _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, len(samples.agent)))
        batch = make_batch(samples.take(rows), np.zeros(len(rows), np.int64))
        seen = batch.state if states is None else torch.from_numpy(states[rows].astype(np.float32))
        logits = planner(seen).push_dead
        if logits is None:
            raise ValueError("this planner does not judge pushes, expected one that was trained with --judge")
        said.append(torch.sigmoid(logits[batch.push_known]).double().numpy())
        dead.append(batch.push_dead[batch.push_known].numpy())
    return Verdicts(np.concatenate(said), np.concatenate(dead))


def reliability(found: Verdicts) -> dict[str, Any]:
    """Return, for bins of what was said, the mean of it, the share that is dead and the number; and the mean error."""
    bins = np.minimum((found.said * _BINS).astype(np.int64), _BINS - 1)
    n, said, dead = (np.bincount(bins, w, _BINS) for w in (None, found.said, found.dead.astype(np.float64)))
    some = n > 0
    return {
        "pushes": len(found.dead),
        "dead": float(found.dead.mean()),
        "said": (said[some] / n[some]).tolist(),
        "is": (dead[some] / n[some]).tolist(),
        "n": n[some].astype(int).tolist(),
        "calibration_error": float(np.abs(said - dead).sum() / n.sum()),
    }


def draw(curves: Mapping[str, Mapping[str, Any]], out: Path) -> None:
    """Draw the diagram, one curve for each kind of state; the more pushes stand behind a point, the larger it is."""
    figure, axis = plt.subplots(figsize=(4.6, 4.8))
    axis.plot([0.0, 1.0], [0.0, 1.0], "--", color="grey", linewidth=1, label="as often as said")
    for name, curve in curves.items():
        label = f"{name} ({curve['pushes']:,} pushes)"
        (line,) = axis.plot(curve["said"], curve["is"], linewidth=1, label=label)
        axis.scatter(curve["said"], curve["is"], _AREA * np.log1p(curve["n"]), color=line.get_color(), clip_on=False)
    axis.set(xlabel="probability that the push is deadly, by the planner", ylabel="share of these pushes that are")
    axis.set(xlim=(0, 1), ylim=(0, 1))
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.tight_layout()
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    for name, file in (("--out", options.out), ("--json", options.json)):
        check_file(name, file)
    planner = load(options.weights, compiled=False)
    levels = Teacher().demonstrate(validation_levels(options.difficulty, options.episodes), np.random.default_rng(0))
    curves = {"levels, as they are": reliability(verdicts(planner, levels))}
    if options.bags:
        lessons = Lessons.read(options.bags, 0, stays=False)
        shown = lessons.samples.take(lessons.estimated)
        curves["decisions, as estimated"] = reliability(verdicts(planner, shown, lessons.estimates[lessons.estimated]))
        curves["the same decisions, as it was"] = reliability(verdicts(planner, shown))
    draw(curves, options.out)
    for name, curve in curves.items():
        print(f"{name}: {curve['pushes']} pushes, {curve['dead']:.1%} dead, off by {curve['calibration_error']:.2%}")
    if options.json is not None:
        give_report(curves, options.json)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
