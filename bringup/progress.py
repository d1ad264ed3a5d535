"""How far a run of episodes is."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bringup.results import EpisodeResult


class SolvedBar(Progress):
    """How many episodes have ended, and how many of these were solved: a bar on stderr, or lines without a terminal.

    It appears when it is told something first, so that nothing stands before the one line of a start that fails.
    """

    def __init__(self, total: int) -> None:
        """Count to `total` episodes."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        super().__init__(*columns, console=Console(stderr=True))
        self._task = self.add_task("solved", total=total)
        self._total, self._printed = total, 0

    def __enter__(self) -> Self:
        """Return the bar."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it is."""
        if self.live.is_started:
            self.stop()

    def show(self, results: Sequence[EpisodeResult]) -> None:
        """Show the outcomes so far."""
        self.start()
        if results:
            share = sum(result.solved for result in results) / len(results)
            solved = f"solved {100 * share:4.1f} %"
            self.update(self._task, completed=len(results), description=solved)
            self._print(len(results), solved)

    def _print(self, ended: int, solved: str) -> None:
        """Print a line whenever another tenth has ended, in a log, which shows a bar only when it is full."""
        if self.console.is_terminal or 10 * (ended - self._printed) < self._total:
            return
        self._printed = ended
        self.console.print(f"{ended} of {self._total} episodes, {solved}")
