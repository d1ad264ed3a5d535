"""What tests of the results' page need: a row that is quick to play, and reports of rows."""

from benchmarks.paper import runs
from bringup.command import Choice, Stack
from bringup.failure import Failure
from bringup.results import EpisodeResult, report
from mujoban_core.plugins import ROLES
from mujoban_core.reports import write_report

ORACLES = Stack({role: Choice(role, "oracle") for role in ROLES})
EASY = runs.Run("easy", "easy", difficulty=1, oracle=tuple(ROLES))


def write(run, solved, of, weights):
    """Write the report of a row of which the first levels were solved."""
    won = [EpisodeResult(i, True, 14.0, 100, 9, 0, 0, None) for i in range(solved)]
    lost = [EpisodeResult(i, False, 3.0, 100, 9, 0, 0, Failure.TIME_LIMIT) for i in range(solved, of)]
    write_report(report([*won, *lost], weights), run.file)
