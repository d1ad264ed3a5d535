"""Progress, TensorBoard and `metrics.jsonl` of a training run."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from datetime import timedelta
from functools import cached_property
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self, TextIO

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text
from torch import Tensor

from mujoban_core.terminal import progress_console
from mujoban_core.text import readable
from mujoban_rl.metrics import METRICS, drop_half_line
from mujoban_rl.run_directory import RunDirectory

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

_SHOWN: Final = 5
"""Numbers that are shown, of those that are logged: the first."""
LINE_SECONDS: Final = 60.0
"""Between two lines of progress in a pipe or file, at least."""


class _Bar(Progress):
    """A progress bar, and below it the newest numbers: as many as the terminal's width holds, each of them whole."""

    def __init__(self, console: Console, count: str) -> None:
        """Make a bar without a task, which begins with `count`, a format of its task."""
        columns = (TextColumn(count), BarColumn(None), TimeElapsedColumn(), TimeRemainingColumn())
        # The base class asks for what is shown as it is made.
        self.numbers: Sequence[str] = ()
        self._terminal = console
        super().__init__(*columns, console=console, refresh_per_second=2, expand=True)

    def get_renderables(self) -> Iterable[RenderableType]:
        """Return the bar, then the numbers."""
        yield self.make_tasks_table(self.tasks)
        shown = next(
            (line for n in range(_SHOWN, 0, -1) if len(line := ", ".join(self.numbers[:n])) <= self._terminal.width), ""
        )
        yield Text(shown)


class TrainingLog:
    """TensorBoard events and `metrics.jsonl` (the source of learning curves) of a run, and its progress on stderr.

    A terminal shows a bar; a pipe or file gets a plain line at most every `LINE_SECONDS`.
    """

    def __init__(
        self,
        run: RunDirectory,
        *,
        total: int | None = None,
        initial: int = 0,
        unit: str = "step",
        console: Console | None = None,
        line_seconds: float = LINE_SECONDS,
    ) -> None:
        """Show progress; the run's files are made, or appended to, with the first line.

        Args:
            run: The run's directory.
            total: Where progress ends, in `unit`s, if it does.
            initial: Where it begins.
            unit: What is counted.
            console: Where progress is shown; by default stderr.
            line_seconds: Between two lines of progress, where there is no terminal.
        """
        self._run, self._files = run.path, ExitStack()
        self._console = console or progress_console()
        end = "" if total is None else f" of {total:,}"
        self._count = f"{{task.completed:,.0f}}{end} {unit}s"
        self._bar = _Bar(self._console, self._count)
        self._task = self._bar.add_task("", total=total, completed=initial)
        self._line_seconds, self._printed, self._unsaid = line_seconds, -math.inf, False
        if self._console.is_interactive:
            self._bar.start()

    def advance(self, n: int = 1) -> None:
        """Move the progress on."""
        self._bar.advance(self._task, n)

    def scalars(self, step: int, values: Mapping[str, float | Tensor], line: str = "") -> None:
        """Write scalars to TensorBoard and `metrics.jsonl`, and show the first few with the progress.

        Args:
            step: What learning curves are drawn against.
            values: Numbers by name.
            line: What is printed of them in any case, if something.
        """
        numbers = {k: float(v) for k, v in values.items()}
        writer, file = self._opened
        for name, value in numbers.items():
            writer.add_scalar(name, value, step)
        finite = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
        file.write(json.dumps({"step": step, "time": round(time.time(), 1), **finite}) + "\n")
        file.flush()
        shown = list(numbers.items())[:_SHOWN]
        self._bar.numbers = [f"{name.rsplit('/')[-1]} {readable(value)}" for name, value in shown]
        self._unsaid = True
        if line:
            self._print(line)
        elif time.monotonic() - self._printed >= self._line_seconds:
            self._print_progress()

    @cached_property
    def _opened(self) -> tuple[SummaryWriter, TextIO]:
        # Takes a quarter of a second to import, which nodes can do without.
        from torch.utils.tensorboard.writer import SummaryWriter

        writer = self._files.enter_context(SummaryWriter(str(self._run / "tensorboard")))
        metrics = self._run / METRICS
        drop_half_line(metrics)
        return writer, self._files.enter_context(metrics.open("a", encoding="utf-8"))

    def _print_progress(self) -> None:
        """Print a line of progress, unless a terminal shows the bar."""
        if not self._console.is_interactive:
            task = self._bar.tasks[0]
            elapsed = timedelta(seconds=int(task.elapsed or 0))
            self._print(f"{self._count.format(task=task)}, {elapsed}: {', '.join(self._bar.numbers)}")

    def _print(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
        self._printed, self._unsaid = time.monotonic(), False

    def close(self) -> None:
        """Show how far the run came; flush and close everything."""
        if self._unsaid:
            self._print_progress()
        if self._console.is_interactive:
            self._bar.stop()
        self._files.close()

    def __enter__(self) -> Self:
        """Return the log itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log."""
        self.close()
