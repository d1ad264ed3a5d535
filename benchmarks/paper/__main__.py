"""Rebuild every table and figure in docs/results/ from the JSON of the evaluations: `make results`.

``python -m benchmarks.paper --check`` only says whether the page is up to date.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.paper import baselines, bodies, comparisons, curves, figures, film, tables
from benchmarks.paper.baselines import AGAIN, BASELINES, HOURS, RECORDING
from benchmarks.paper.runs import (
    AHEAD,
    ALL,
    CONFIGURATIONS,
    DIFFICULTY,
    EXPLORING,
    GRAPH,
    LOOKING_AROUND,
    POLICY_ALONE,
    RESULTS,
    SCOUT_FOLDER,
    SEED,
)
from mujoban_core.bodies import ANT, BALL
from mujoban_core.plugins import TOLD, privileged_roles
from mujoban_core.program import read_options, run_command
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.rendering import RenderingError

INTRODUCTION = f"""# Results

`make results` rebuilds this page and its figures from the files in `json/`, in seconds. What lies there was measured by

    python -m benchmarks.paper.runs                    # everything: hours on two cores; goes on where it was ended
    python -m benchmarks.paper.runs --only NAME        # one row, by the name in its table, film_strip or film_strip_ant
    python -m benchmarks.paper.runs --only NAME_1      # an agent of Table 1 by that name, at difficulty 1
    python -m benchmarks.paper.curves --help           # learning curves from the run directories of trainers

Rows are of the *{DEFAULT_WORLD}* world, the environment that the paper's authors released, as measured in its recorded
runs ([worlds](../world.md#two-worlds)).

Rows run `bringup/evaluate.py` on n levels of the generator with the seeds {SEED} to {SEED} + n - 1, never used in
training (paper: n = 512), nor to choose anything ([levels](../levels.md#the-five-difficulties)), but for one case:
when the row *V-trace* had solved 36.5 % of their difficulty 1, V-trace was given more updates and other settings, tried
on validation levels, and measured again ([how](../research/baselines.md#how-often-v-trace-learns)). Intervals are 95 %
Wilson intervals of the success rate, s.e. is the standard error. A row marked † was measured with other weights than
those that ship now; the JSON has the digests of its weights, and every episode.
"""
TABLE_1 = """The agents that modular RL is compared with ([how each is trained](../baselines.md)). The
paper trained them for up to 21 days with 1,000 actors (fully observable) and 5 days with 256 (partially observable),
and reports the best of many settings; here steps and CPU hours are what the row was given.
"""
BUDGETS = f"""Rows trained on nothing are the floor. Every other one but that of the stack as it ships is given the
environment steps of the modular row and its {HOURS:g} h of two cores, whichever is spent first: rows of less than
{2 * HOURS:g} CPU hours were ended by their steps. To learn from each of them more often brought MPO there sooner, [not
further](../research/baselines.md#torques-that-are-held); that is of one seed, up to 0.65 M steps, and says nothing of
V-trace. Not counted are the recording of what is cloned, and the weights of the stack that ships where a row begins
with them.
`python -m benchmarks.paper.table1` trains and evaluates one row after the other, and goes on where it was stopped. Its
commands are
"""
EQUAL = """What equal budgets leave unequal: steps of the modular row are those of its controller's trainings and of its
recordings; what its planner plays under the abstract rules costs CPU time alone. CPU hours compare rows of one machine:
the two cores of the modular row computed in bfloat16. The stack fine-tuned as a whole learned on slower cores, which
take three times the CPU time for an update of it: its CPU hours ended it. All rows had other trainings beside, hence
their times by the clock. Of the modular row's modules the controller is the one that solved the most validation levels,
the planner a moving average of its weights, as is the controller of the stack fine-tuned as a whole; the senses, all
agents and the fine-tuned planner are as their training left them. Agents that learn by MPO or cloning are of size S; M
and L: not trained.
"""
CURVES = """In training, with exploration; agents that learn by MPO with a limit of 45 s. Bars are 95 % intervals
(Wilson) of the episodes that ended since the point before. What ended before each robot had played for the time limit
is left out: all begin at once, and the first to end are those that were solved soon. A row that trains on one
difficulty has a curve of that one, and a point is of 20 episodes at least. The modular row's learning is in [the report
of its training](../research/one_hour/report.md), module by module; cloning plays nothing while it learns.
"""
FIGURE_2 = """At every difficulty by the planner's policy alone, and as by default, with its search ahead. The rows of
[Table 1](#table-1-main-results) are drawn as well, each with a marker of its own and a little aside.
"""
FIGURE_4 = """The trainings of the [weights that ship](../weights.md#the-weights-that-ship), and in orange those of
other networks. Runs of a module are drawn end to end, so that a curve may drop where one begins, and the axes of rates
are cut.

- Controller: its trainings as a camera policy, as a student and by MPO, three times each, beside those of its teacher,
  by reward from nothing. While a student learns, its teacher drives at first, later a fifth of the robots.
- Planner: its three trainings on a core; the one before them, [on a GPU](../research/weights.md), left no curve. Beside
  it the planner of [eight hours of `make weights`](../research/eight_hours/report.md), which does not ship: from
  nothing, on two cores. A sample is an evaluation of the network in the search that teaches it.
- Estimator and termination: two rounds of one training. The second round of bags, of the stack at work, is harder for
  the termination. On [recordings that can tell](../research/estimator.md#recordings-to-judge-by) 98.2 % of its ends
  are within 2 ticks.

The [model cards](../models/) have the scores of the weights that ship.
"""
FIGURE_5 = """With ground-truth sense, as in the paper, but for the last row. Both bodies have the same planner, which
knows of none.
"""
TABLE_2 = """Each configuration replaces modules by oracles.
"""


PAGE: Final = "README.md"
PROG: Final = "benchmarks.paper"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    out: Path = RESULTS
    """Folder of the page and its figures."""
    check: bool = False
    """Only say whether the page there is up to date, with status 1 if it is not."""


def rebuild(folder: Path) -> Path:
    """Write the page and its figures into a folder; return the path of the page.

    Raises:
        ResultError: If a source is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sections = [
        INTRODUCTION,
        tables.test_uses((*ALL, *bodies.RUNS, *baselines.RUNS), map(film.load, film.FILMS.values())),
        "## Table 1: main results\n",
        tables.configurations((CONFIGURATIONS[0], POLICY_ALONE[0])),
        TABLE_1,
        tables.baselines(),
        comparisons.distinct_levels(),
        comparisons.against_floor(),
        comparisons.copying(),
        BUDGETS,
        tables.commands(BASELINES, RECORDING),
        comparisons.seeds(),
        "<details><summary>All but the modular row once more, with another seed: commands</summary>\n",
        tables.commands(AGAIN),
        "</details>\n",
        EQUAL,
        comparisons.ended_by_steps(),
        tables.fine_tuned(),
        *_baseline_curves(folder),
        "## Table 2: module evaluation\n",
        TABLE_2,
        tables.configurations(CONFIGURATIONS),
        "Why episodes fail:\n",
        tables.failures(CONFIGURATIONS),
        "Beside these rows:\n",
        tables.configurations((GRAPH, *POLICY_ALONE)),
        "Why their episodes fail:\n",
        tables.failures((GRAPH, *POLICY_ALONE)),
        tables.differences(CONFIGURATIONS[0], GRAPH),
        "What says where to look before pushing:\n",
        tables.configurations(LOOKING_AROUND),
        "Why their episodes fail:\n",
        tables.failures(LOOKING_AROUND),
        f"The learned one was trained by `{EXPLORING}`; its weights do not ship, and lie in `{SCOUT_FOLDER}/`.\n",
        "## Figure 2: success against difficulty\n",
        FIGURE_2,
        tables.configurations((*DIFFICULTY, *AHEAD)),
        "Why their episodes fail:\n",
        tables.failures((*DIFFICULTY, *AHEAD)),
        *_figure_2(folder),
        "## Figure 3: an episode\n",
        *_film_strip(BALL.name, "Figure 3", folder / "figure3.png"),
        "## Figure 4: learning curves\n",
        *_figure_4(folder),
        "## Figure 5: another body, the same planner\n",
        FIGURE_5,
        tables.configurations(bodies.RUNS),
        "Why episodes fail:\n",
        tables.failures(bodies.RUNS),
        *_figure_5(folder),
        *_film_strip(ANT.name, "An episode of the ant", folder / "figure5_ant.png"),
    ]
    page = folder / PAGE
    page.write_text("\n".join(sections))
    return page


def is_current(folder: Path) -> bool:
    """Tell whether the text of a folder's page is what the sources say; its figures may differ with the libraries."""
    page = folder / PAGE
    with tempfile.TemporaryDirectory() as place:
        return page.is_file() and page.read_text() == rebuild(Path(place)).read_text()


def _figure_2(folder: Path) -> list[str]:
    if figures.difficulty(DIFFICULTY, AHEAD, folder / "figure2.png"):
        return ["![Success rate against difficulty](figure2.png)\n"]
    return _missing("Figure 2", "python -m benchmarks.paper.runs")


def _baseline_curves(folder: Path) -> list[str]:
    if figures.baseline_curves(folder / "baselines.png"):
        return [CURVES, comparisons.short_curves(), "![Learning curves of agents](baselines.png)\n"]
    return _missing("The curves of agents", "python -m benchmarks.paper.baselines NAME=RUN")


def _film_strip(body: str, what: str, file: Path) -> list[str]:
    recorded = film.FILMS[body]
    episode = film.load(recorded)
    if episode is None:
        return _missing(what, recorded.rerun)
    try:
        film.draw(episode, file)
    except RenderingError as error:
        print(f"{what} stays as it was: {error}", file=sys.stderr)
    stale = tables.STALE if film.is_stale(recorded, episode) else ""
    told = privileged_roles(episode["weights"])
    named = f" {TOLD.capitalize()}: {', '.join(told)}." if told else ""
    text = (
        "Top row: what the robot sees. Bottom row: the view from above, which it does not see. Seed "
        f"{episode['seed']}, difficulty {episode['difficulty']}, solved in {len(episode['torque'])} steps with "
        f"{len(episode['instructions'])} instructions. The arrow is the instruction in force, up being north in the "
        f"bottom row; a dot is STAY, as while it looks around.{named}{stale}\n"
    )
    return [text, f"![Frames of an episode that was solved]({file.name})\n"]


def _figure_4(folder: Path) -> list[str]:
    missing = figures.curves(folder / "figure4.png")
    sections = []
    if len(missing) < len(curves.MODULES):
        sections += [FIGURE_4, "![Learning curves of the modules](figure4.png)\n"]
    if missing:
        options = " ".join(f"--{module} RUN" for module in missing)
        sections += _missing(f"The curve of {', '.join(missing)}", f"python -m benchmarks.paper.curves {options}")
    return sections


def _figure_5(folder: Path) -> list[str]:
    if bodies.draw(folder / "figure5.png"):
        return ["![Success rate of ball and ant against difficulty](figure5.png)\n"]
    return _missing("Figure 5", f"python -m benchmarks.paper.runs --only {' '.join(run.name for run in bodies.RUNS)}")


def _missing(what: str, command: str) -> list[str]:
    print(f"{what} has no source yet: {command}", file=sys.stderr)
    return [f"{what}: not measured yet (`{command}`).\n"]


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    if not options.check:
        print(rebuild(options.out))
        return 0
    current = is_current(options.out)
    if not current:
        print(f"{options.out / PAGE} is not up to date")
    return int(not current)


if __name__ == "__main__":
    run_command(PROG, main)
