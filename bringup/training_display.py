"""What a terminal shows of a run of all trainings."""

from __future__ import annotations

from datetime import datetime, timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from bringup.pipeline import Pipeline
from mujoban_core.terminal import progress_console


class Display:
    """A line a stage: what it has taken of what it may take, and when all are expected to be done.

    A pipe or file is told when each begins, has taken another tenth of its time, and ends.
    """

    def __init__(self, pipeline: Pipeline, console: Console) -> None:
        """Show that all stages wait."""
        columns = (TextColumn("{task.description}"), BarColumn(None), TextColumn("{task.fields[note]}"))
        self.progress = Progress(
            *columns, console=console, refresh_per_second=1, expand=True, disable=not console.is_interactive
        )
        self._all = self.progress.add_task("all", total=1.0, note="")
        self._tasks: dict[str, TaskID] = {
            s.name: self.progress.add_task(s.name, total=s.seconds, note="waits") for s in pipeline.stages
        }
        self._told = dict.fromkeys(self._tasks, "waits")

    def update(self, pipeline: Pipeline) -> None:
        """Show how far every stage is."""
        remaining = pipeline.remaining()
        ends = f"{datetime.now() + timedelta(seconds=remaining):%a %H:%M}"
        passed = pipeline.seconds() / (pipeline.seconds() + remaining) if remaining else 1.0
        self.progress.update(self._all, completed=passed, note=f"expected to end on {ends}")
        for stage in pipeline.stages:
            spent, done = pipeline.elapsed(stage.name), pipeline.entries[stage.name].done
            if done:
                state, note = "done", f"done in {_minutes(spent)}"
            elif stage.name in pipeline.running():
                note = f"{_minutes(spent)} of about {_minutes(stage.seconds)}"
                state = f"runs, part {_part(spent / stage.seconds)}"
            else:
                state = note = "waits"
            shown = stage.seconds if done else min(spent, stage.seconds)
            self.progress.update(self._tasks[stage.name], completed=shown, note=note)
            if self.progress.disable and state != self._told[stage.name]:
                line = f"{stage.name}: {note}" + ("" if done else f"; all is expected to end on {ends}")
                self.progress.console.print(line, highlight=False, soft_wrap=True)
            self._told[stage.name] = state


def run_shown(pipeline: Pipeline) -> None:
    """Run a pipeline's stages that are not done yet, and show on stderr how far they are.

    Raises:
        PipelineError: If a stage fails.
        Interrupted: If a signal came.
    """
    display = Display(pipeline, progress_console())
    with display.progress:
        pipeline.run(display.update)
        display.update(pipeline)


def _part(share: float) -> int:
    """Return how many tenths of its time a stage has taken; beyond its time only wholes count."""
    return int(10 * share) if share < 1.0 else 9 + int(share)


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 60 else f"{seconds:.0f} s"
