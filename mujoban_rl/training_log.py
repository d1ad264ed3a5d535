"""Progress bar, TensorBoard and `metrics.jsonl` of a training run."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from torch import Tensor
from torch.utils.tensorboard.writer import SummaryWriter
from tqdm import tqdm

from mujoban_rl.run_directory import RunDirectory


class TrainingLog:
    """Progress bar, TensorBoard events and `metrics.jsonl` (the source of learning curves) of a run."""

    def __init__(self, run: RunDirectory, *, total: int | None = None, initial: int = 0, unit: str = "step") -> None:
        """Append to the run's files; `total` and `initial` are in `unit`s of the progress bar."""
        self._writer = SummaryWriter(str(run.path / "tensorboard"))
        self._file = (run.path / "metrics.jsonl").open("a", encoding="utf-8")
        self._bar = tqdm(total=total, initial=initial, unit=unit, dynamic_ncols=True, mininterval=1.0)

    def advance(self, n: int = 1) -> None:
        """Move the progress bar."""
        self._bar.update(n)

    def scalars(self, step: int, values: Mapping[str, float | Tensor]) -> None:
        """Write scalars to TensorBoard and `metrics.jsonl`, and show the first few in the progress bar."""
        numbers = {k: float(v) for k, v in values.items()}
        for name, value in numbers.items():
            self._writer.add_scalar(name, value, step)
        finite = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
        self._file.write(json.dumps({"step": step, "time": round(time.time(), 1), **finite}) + "\n")
        self._file.flush()
        self._bar.set_postfix({k.rsplit("/")[-1]: f"{v:.3g}" for k, v in list(numbers.items())[:5]}, refresh=False)

    def message(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        self._bar.write(text)

    def close(self) -> None:
        """Flush and close everything."""
        self._bar.close()
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
