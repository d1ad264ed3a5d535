"""How far a run of episodes is."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bringup.results import EpisodeResult
from mujoban_core.terminal import progress_console


class EpisodesBar(Progress):
    """How many episodes have ended: a bar on stderr, or plain lines where that is a pipe or file.

    It appears when it is told something first, so that nothing stands before the one line of a start that fails.
    """

    def __init__(self, total: int, console: Console | None = None) -> None:
        """Count to `total` episodes, on stderr unless another console is given."""
        columns = (TextColumn("{task.description}"), BarColumn(None), MofNCompleteColumn(), TimeElapsedColumn())
        super().__init__(*columns, console=console or progress_console(), expand=True)
        self._task = self.add_task("", total=total)
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

    def reach(self, ended: int, what: str) -> None:
        """Show that so many episodes have ended.

        Args:
            ended: Number of episodes.
            what: Two or three words of what came of them.
        """
        if self.console.is_interactive:
            self.start()
            self.update(self._task, completed=ended, description=what)
        elif ended > self._printed and (ended == self._total or 10 * (ended - self._printed) >= self._total):
            self._printed = ended
            self.console.print(f"{ended} of {self._total} episodes {what}", highlight=False, soft_wrap=True)


class SolvedBar(EpisodesBar):
    """How many episodes have ended, and what share of these was solved."""

    def show(self, results: Sequence[EpisodeResult]) -> None:
        """Show the outcomes so far."""
        if results:
            share = sum(result.solved for result in results) / len(results)
            self.reach(len(results), f"ended, {100 * share:.1f} % solved")
        else:
            self.reach(0, "ended")
