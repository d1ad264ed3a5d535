"""The report of a command that plays episodes: short on the terminal, whole as JSON, also when it was interrupted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

from rich.console import Console
from rich.table import Table

from bringup.command import Player
from bringup.options import EpisodeOptions
from bringup.results import EpisodeResult, report, summary
from mujoban_core.bodies import get_body
from mujoban_core.commit import commit_of
from mujoban_core.files import digest
from mujoban_core.reports import keep_report
from mujoban_core.signals import StopSignal
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import seed_range

if TYPE_CHECKING:
    from bringup.stack import Outcome

Route = Literal["in process", "graph"]
"""What carries steps between world and modules: the memory of a process, or ROS messages."""


def played(
    player: Player,
    episodes: Episodes,
    options: EpisodeOptions,
    *,
    route: Route = "in process",
    batch: int | None = None,
    realtime: float = 0.0,
) -> dict[str, Any]:
    """Return what a report says of the game, beside who played it.

    Args:
        player: The modules, or an agent.
        episodes: Which are played.
        options: World, body and time limit.
        route: How they are played.
        batch: Episodes at the same time in a process; None where one follows the other.
        realtime: Simulated seconds per second; 0 is lockstep.

    Returns:
        `difficulty` of generated levels, or `level_file` with its SHA-256; `seed` of the first episode; `time_limit` in
        steps; `body`, `world`, `route`, `batch`, `realtime`; and the settings of the player. What does not apply is
        None.

    Raises:
        OSError: If the level file cannot be read.
    """
    file = episodes.level_file
    return {
        "difficulty": episodes.difficulty or None,
        "level_file": None if file is None else str(file),
        "level_file_sha256": None if file is None else digest(file),
        "seed": episodes.seed,
        "time_limit": options.time_limit or get_body(options.body).time_limit,
        "body": options.body,
        "world": options.world,
        "route": route,
        "batch": batch,
        "realtime": realtime,
        **player.settings(),
    }


class Reporting:
    """Context in which episodes are played; when an interruption ends it, what has been played is reported.

    Attributes:
        results: Outcomes so far, in any order.
        figures: Further entries of what is reported after an interruption, such as counts.
    """

    def __init__(
        self, path: Path | None, weights: Mapping[str, str], episodes: Episodes, game: Mapping[str, Any]
    ) -> None:
        """Describe the report.

        Args:
            path: File that takes it as JSON, if any.
            weights: Name of each module -> what identifies it.
            episodes: Which are played.
            game: What `played` tells of it.

        Raises:
            ValueError: If levels are generated from seeds that do not all lie in one range.
        """
        self.results: Sequence[EpisodeResult] = []
        self.figures: Mapping[str, Any] = {}
        self._path, self._weights, self._asked = path, weights, len(episodes)
        self._game = {"body": game["body"], "world": game["world"], "played": dict(game)}
        # Apart from the game, which is the same in all parts of a longer run.
        self._game |= {"first_number": episodes.first_number, "commit": commit_of(Path(__file__).resolve())}
        # Of a level file seeds do not tell which levels are kept for tests.
        self._generated = not episodes.source.levels
        if self._generated:
            seed_range(episodes.seed, len(episodes))  # refuses what `finish` could not report

    def note(self, outcome: Outcome) -> None:
        """Note what came of a run of the graph that was broken off."""
        self.results, self.figures = outcome.results, outcome.figures()

    def finish(self, results: Sequence[EpisodeResult], *, above: Table | None = None, **extra: Any) -> None:
        """Write the report and print the summary; an interruption waits for that.

        Args:
            results: The episodes.
            above: What is printed above the summary.
            **extra: Further entries.

        Raises:
            OSError: If it cannot be written.
            Interrupted: If the process was asked to end meanwhile.
        """
        with StopSignal() as stop:
            self._tell(results, above, extra)
        stop.check()

    def _tell(self, results: Sequence[EpisodeResult], above: Table | None, extra: Mapping[str, Any]) -> None:
        self.results = ()  # they are told
        content = report(results, self._weights, **self._game, **extra)
        if self._generated:
            from mujoban_rl.sealed_levels import noted_use

            seeds = [entry["seed"] for entry in content["episodes"]]
            content |= noted_use(seeds, self._weights, content["played"])
        keep_report(content, self._path)  # before anything is printed, which nobody may read any more
        if above is not None:
            Console().print(above)
        print(*summary(content), sep="\n", flush=True)

    def __enter__(self) -> Self:
        """Return the report itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Report what there is after an interruption or an error: also that test levels were used."""
        if isinstance(value, KeyboardInterrupt | SystemExit | Exception) and self.results:
            with StopSignal():
                played = sorted(self.results, key=lambda result: result.seed)
                self._tell(played, None, {"interrupted": self._asked, **self.figures})
