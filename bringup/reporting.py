"""The report of a command that plays episodes: short on the terminal, whole as JSON, also when it was interrupted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from bringup.results import EpisodeResult, report, summary, use_of_test_levels, write_report
from mujoban_core.signals import StopSignal
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import seed_range


class Reporting:
    """Context in which episodes are played; when an interruption ends it, what has been played is reported.

    Attributes:
        results: Outcomes so far, in any order.
    """

    def __init__(self, path: Path | None, weights: Mapping[str, str], episodes: Episodes, **extra: Any) -> None:
        """Describe the report.

        Args:
            path: File that takes it as JSON, if any.
            weights: Name of each module -> what identifies it.
            episodes: Which are played.
            **extra: Further entries.

        Raises:
            ValueError: If levels are generated from seeds that do not all lie in one range.
        """
        self.results: Sequence[EpisodeResult] = []
        self._path, self._weights, self._asked, self._extra = path, weights, len(episodes), extra
        # Of a level file seeds do not tell which levels are kept for tests.
        generated = not episodes.source.levels
        self._on_test_levels = generated and seed_range(episodes.seed, len(episodes)) == "test"

    def finish(self, results: Sequence[EpisodeResult], **extra: Any) -> None:
        """Print the summary and write the report.

        Raises:
            OSError: If it cannot be written.
        """
        content = report(results, self._weights, **self._extra, **extra)
        if self._on_test_levels:
            from mujoban_rl.weights import provenance

            content["test_uses"] = [use_of_test_levels(content, provenance()["commit"])]
        print(*summary(content), sep="\n", flush=True)
        if self._path is not None:
            write_report(content, self._path)

    def __enter__(self) -> Self:
        """Return the report itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Report what there is after an interruption."""
        if isinstance(value, KeyboardInterrupt) and self.results:
            with StopSignal():
                self.finish(sorted(self.results, key=lambda result: result.seed), interrupted=self._asked)
