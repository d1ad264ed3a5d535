"""Progress bar, TensorBoard and `metrics.jsonl` of a training run."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor
from torch.utils.tensorboard.writer import SummaryWriter

from mujoban_rl.run_directory import RunDirectory


class TrainingLog:
    """Progress bar, TensorBoard events and `metrics.jsonl` (the source of learning curves) of a run."""

    def __init__(self, run: RunDirectory, *, total: int | None = None, initial: int = 0, unit: str = "step") -> None:
        """Append to the run's files; `total` and `initial` are in `unit`s of the progress bar."""
        self._writer = SummaryWriter(str(run.path / "tensorboard"))
        self._file = (run.path / "metrics.jsonl").open("a", encoding="utf-8")
        columns = (
            TextColumn("{task.completed:.0f} {task.fields[unit]}s"), BarColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), TextColumn("{task.description}", markup=False),
        )  # fmt: skip
        self._progress = Progress(*columns, console=Console(stderr=True), refresh_per_second=2)
        self._bar = self._progress.add_task("", total=total, completed=initial, unit=unit)
        self._progress.start()

    def advance(self, n: int = 1) -> None:
        """Move the progress bar."""
        self._progress.advance(self._bar, n)

    def scalars(self, step: int, values: Mapping[str, float | Tensor]) -> None:
        """Write scalars to TensorBoard and `metrics.jsonl`, and show the first few in the progress bar."""
        numbers = {k: float(v) for k, v in values.items()}
        for name, value in numbers.items():
            self._writer.add_scalar(name, value, step)
        finite = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
        self._file.write(json.dumps({"step": step, "time": round(time.time(), 1), **finite}) + "\n")
        self._file.flush()
        shown = [f"{name.rsplit('/')[-1]} {value:.3g}" for name, value in list(numbers.items())[:5]]
        self._progress.update(self._bar, description=", ".join(shown))

    def message(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        """Flush and close everything."""
        self._progress.stop()
        self._writer.close()
        self._file.close()

    def __enter__(self) -> Self:
        """Return the log itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log."""
        self.close()
