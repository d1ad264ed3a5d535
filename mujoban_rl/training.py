"""What every trainer needs: run directory, checkpoints, NaN guard, stop signal, log and progress.

A typical trainer::

    run = RunDirectory(options.run, config)
    log, guard = TrainingLog(run, total=options.steps), NaNGuard()
    step = 0
    if (snapshot := run.load(modules={"policy": policy}, optimisers={"adam": adam})) is not None:
        step = snapshot.step
    with StopSignal() as stop, TimeLimit(options.seconds) as limit:
        while step < options.steps and not stop.requested and not limit.reached:
            loss = ...
            if guard.accept(loss):
                ...
            log.scalars(step, {"loss": loss})
    run.save(step, modules=..., optimisers=..., extra={"rng": rng.bit_generator.state})
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as dump_tensors
from torch import Tensor, nn
from torch.utils.tensorboard.writer import SummaryWriter
from tqdm import tqdm

from mujoban_core.files import write_atomically
from mujoban_rl.weights import WeightsError, check_finite


class RunError(ValueError):
    """A run directory cannot be used: another configuration, or no intact checkpoint."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """What a checkpoint holds beside the modules and optimisers that were restored in place."""

    step: int
    extra: dict[str, Any]
    """JSON values: random states, schedules, counters."""
    tensors: dict[str, Tensor]
    """Loose tensors, such as `torch.Generator` states."""


class RunDirectory:
    """Directory of one training run: `config.json`, checkpoints, `metrics.jsonl`, TensorBoard events.

    Checkpoints are `checkpoint-<step>.safetensors` with a JSON part beside that is written last, so a file pair
    is whole or is ignored. The last `keep` survive.
    """

    def __init__(self, path: str | Path, config: Any, *, keep: int = 2) -> None:
        """Create the directory, or reopen it when its configuration is the same.

        Args:
            path: Directory; an existing one is resumed.
            config: Dataclass or mapping; what must not change between the bits of a run.
            keep: Number of checkpoints kept.

        Raises:
            RunError: If the directory belongs to a run with another configuration.
        """
        self.path = Path(path)
        self.keep = keep
        fields = dataclasses.asdict(config) if dataclasses.is_dataclass(config) else dict(config)  # type: ignore[arg-type]
        self.config: dict[str, Any] = json.loads(json.dumps(fields, default=str))
        self.path.mkdir(parents=True, exist_ok=True)
        file = self.path / "config.json"
        if file.exists():
            stored = json.loads(file.read_text())
            changed = sorted(k for k in stored.keys() | self.config.keys() if stored.get(k) != self.config.get(k))
            if changed:
                pairs = ", ".join(f"{k}: {stored.get(k)!r} there, {self.config.get(k)!r} now" for k in changed)
                raise RunError(f"{self.path}: a run with another configuration ({pairs}); choose another directory")
        else:
            write_atomically(file, (json.dumps(self.config, indent=2) + "\n").encode())

    def save(
        self,
        step: int,
        *,
        modules: Mapping[str, nn.Module],
        optimisers: Mapping[str, torch.optim.Optimizer] | None = None,
        extra: Mapping[str, Any] | None = None,
        tensors: Mapping[str, Tensor] | None = None,
    ) -> Path:
        """Write a checkpoint atomically, then drop the oldest ones.

        Args:
            step: Number of training steps done.
            modules: Modules by name; their `state_dict` is stored.
            optimisers: Optimisers by name; moments and hyper-parameters are stored.
            extra: JSON-serialisable values.
            tensors: Further tensors.

        Returns:
            Path of the safetensors file.

        Raises:
            WeightsError: If a value is not finite; no file is written then.
        """
        flat: dict[str, Tensor] = {}
        for name, module in modules.items():
            flat |= {f"module/{name}/{k}": v for k, v in module.state_dict().items()}
        scalars: dict[str, Any] = {}
        for name, optimiser in (optimisers or {}).items():
            moments, scalars[name] = _split_optimiser(optimiser.state_dict())
            flat |= {f"optimiser/{name}/{k}": v for k, v in moments.items()}
        flat |= {f"tensor/{k}": v for k, v in (tensors or {}).items()}
        # clone: safetensors refuses tensors that share storage
        flat = {k: v.detach().cpu().contiguous().clone() for k, v in flat.items()}
        check_finite(flat, f"checkpoint at step {step}")
        data = dump_tensors(flat)
        content = {
            "step": step,
            "digest": hashlib.sha256(data).hexdigest(),
            "optimisers": scalars,
            "extra": dict(extra or {}),
        }
        text = json.dumps(content, allow_nan=False)
        path = self.path / f"checkpoint-{step:010d}.safetensors"
        write_atomically(path, data)
        write_atomically(path.with_suffix(".json"), text.encode())
        for old in self._checkpoints()[self.keep :]:
            old.unlink(missing_ok=True)
            old.with_suffix(".json").unlink(missing_ok=True)
        return path

    def load(
        self,
        *,
        modules: Mapping[str, nn.Module],
        optimisers: Mapping[str, torch.optim.Optimizer] | None = None,
    ) -> Snapshot | None:
        """Restore the newest intact checkpoint in place; return None when there is no checkpoint.

        Raises:
            RunError: If there are checkpoints but none is intact.
        """
        candidates = self._checkpoints()
        for path in candidates:
            loaded = _read_checkpoint(path)
            if loaded is None:
                continue
            content, flat = loaded
            for name, module in modules.items():
                module.load_state_dict(_below(flat, f"module/{name}/"))
            for name, optimiser in (optimisers or {}).items():
                state = _join_optimiser(_below(flat, f"optimiser/{name}/"), content["optimisers"][name])
                optimiser.load_state_dict(state)
            return Snapshot(content["step"], content["extra"], _below(flat, "tensor/"))
        if candidates:
            raise RunError(f"{self.path}: none of {len(candidates)} checkpoints is intact")
        return None

    def _checkpoints(self) -> list[Path]:
        return sorted(self.path.glob("checkpoint-*.safetensors"), reverse=True)


def _read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """Return the JSON and tensor parts of a checkpoint, or None when it is damaged."""
    try:
        content = json.loads(path.with_suffix(".json").read_text())
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != content["digest"]:
            return None
        return content, load_tensors(data)
    except (OSError, json.JSONDecodeError, KeyError, SafetensorError):
        return None


def _below(flat: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in flat.items() if k.startswith(prefix)}


def _split_optimiser(state: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Split an optimiser's state into tensors by `parameter/key` and the JSON rest."""
    moments: dict[str, Tensor] = {}
    rest: dict[str, dict[str, Any]] = {}
    for index, values in state["state"].items():
        for key, value in values.items():
            if isinstance(value, Tensor):
                moments[f"{index}/{key}"] = value
            else:
                rest.setdefault(str(index), {})[key] = value
    return moments, {"state": rest, "param_groups": state["param_groups"]}


def _join_optimiser(moments: Mapping[str, Tensor], scalars: dict[str, Any]) -> dict[str, Any]:
    state: dict[int, dict[str, Any]] = {int(k): dict(v) for k, v in scalars["state"].items()}
    for name, value in moments.items():
        index, key = name.split("/", 1)
        state.setdefault(int(index), {})[key] = value
    return {"state": state, "param_groups": scalars["param_groups"]}


class NaNGuard:
    """Keep non-finite updates away from the weights; give up when they do not stop."""

    def __init__(self, patience: int = 20) -> None:
        """Tolerate at most `patience` non-finite steps in a row."""
        self.patience = patience
        self.skipped = 0
        """Steps refused so far."""
        self._in_a_row = 0

    def accept(self, *values: Tensor | float) -> bool:
        """Return whether all values (losses, gradient norm) are finite; if not, the step must be skipped.

        Raises:
            FloatingPointError: After `patience` refusals in a row.
        """
        finite = all(
            bool(torch.isfinite(v).all()) if isinstance(v, Tensor) else math.isfinite(v) for v in values
        )
        self._in_a_row = 0 if finite else self._in_a_row + 1
        self.skipped += not finite
        if self._in_a_row > self.patience:
            raise FloatingPointError(f"training diverged: {self._in_a_row} non-finite steps in a row")
        return finite


class StopSignal:
    """Context in which SIGINT and SIGTERM ask the loop to end instead of killing it."""

    _SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.requested = False
        """Whether a signal came; a second SIGINT interrupts at once."""
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        """Install the handlers."""
        self._previous = {s: signal.signal(s, self._handle) for s in self._SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the former handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.requested = True


class TimeLimit:
    """Wall-clock limit of one bit of a run."""

    def __init__(self, seconds: float | None) -> None:
        """Count from now; None never ends."""
        self._seconds = math.inf if seconds is None else seconds
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the limit was made."""
        return time.monotonic() - self._start

    @property
    def reached(self) -> bool:
        """Whether the time is up."""
        return self.elapsed >= self._seconds


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


__all__ = [
    "NaNGuard",
    "RunDirectory",
    "RunError",
    "Snapshot",
    "StopSignal",
    "TimeLimit",
    "TrainingLog",
    "WeightsError",
]
