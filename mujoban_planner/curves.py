"""Draw learning curves of planners, and print them: `... mujoban_planner.curves RUN... --names "MPO alone" ...`.

What is general about it stands in `mujoban_rl.curves`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mujoban_core.program import read_options, run_command
from mujoban_rl.curves import CurveOptions, read_chart, show

PROG = "mujoban_planner.curves"

_DRC: Final = {
    "DRC(3,3), published": ((10e6, 0.34), (20e6, 0.81), (50e6, 0.93), (100e6, 0.96), (2e9, 0.99)),
}
"""Moves of training and solve rate of DRC(3,3) on the unfiltered levels of Boxoban, by IMPALA (Guez et al. 2019)."""


@dataclass(frozen=True)
class Options(CurveOptions):
    """Solve rate on held-out levels over samples and over CPU time: a picture, and tables on standard output, Markdown.

    The tables have rows of equal samples and of equal CPU minutes, linear between the evaluations of a run, and blank
    before its first and after its last one.

    A sample is a labelled state (imitation), an instruction (MPO), a push (PPO and MPO over pushes) or a network
    evaluation of a search (expert iteration).
    """

    out: Path = Path("planner_curve.png")
    """Image to write."""
    difficulty: int = 5
    """Difficulty whose solve rate is drawn."""
    published: bool = False
    """Show DRC(3,3) against its samples too, which are moves, on the unfiltered levels of Boxoban."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    what = f"success rate, difficulty {options.difficulty}"
    metric = f"evaluation/success_rate/{options.difficulty}"
    show(read_chart(options, metric, what, _DRC if options.published else None), options)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
