"""What tests of the results' page need: a row that is quick to play, and reports of rows."""

from benchmarks.paper import runs
from bringup.command import Choice, Stack
from bringup.results import EpisodeResult, report
from mujoban_core.plugins import ROLES
from mujoban_core.reports import write_report

ORACLES = Stack({role: Choice(role, "oracle") for role in ROLES})
EASY = runs.Run("easy", "easy", difficulty=1, oracle=tuple(ROLES))


def write(run, solved, of, weights):
    """Write the report of a row of which the first levels were solved."""
    episodes = [EpisodeResult(i, i < solved, 14.0 if i < solved else 3.0, 100, 9, 0, 0, None) for i in range(of)]
    write_report(report(episodes, weights), run.file)
