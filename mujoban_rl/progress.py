"""What a training run may spend and has spent, what it does how often, and the means of what it reports."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Budget:
    """What a run may spend; schedules follow whichever share is spent most. All bits of the run count together."""

    samples: float = math.inf
    updates: float = math.inf
    seconds: float = math.inf
    """Wall-clock seconds of training; makes schedules, and so the run, depend on the machine."""
    cpu_seconds: float = math.inf
    """CPU seconds of all processes of the run; depends on the machine too, but not on what else runs there."""

    def __post_init__(self) -> None:
        """Reject budgets that are no amounts."""
        for amount in fields(self):
            if not getattr(self, amount.name) > 0:
                raise ValueError(f"budget of {getattr(self, amount.name)} {amount.name}: expected a positive number")


@dataclass(frozen=True)
class Cadence:
    """How often a run logs, publishes, evaluates and saves."""

    log_updates: int = 100
    publish_updates: int = 10
    evaluate_samples: float = math.inf
    """Samples between evaluations; the end of a bit of the run is evaluated too, unless a signal asks to stop."""
    evaluate_seconds: float = math.inf
    """Wall-clock seconds between evaluations; 0: after every update."""
    save_seconds: float = 120.0
    """Wall-clock seconds between checkpoints, likewise."""
    evaluate_first: bool = False
    """Evaluate also what the run begins with."""

    def __post_init__(self) -> None:
        """Reject what is no distance between two of a kind."""
        for verb, count, unit in (
            ("log", self.log_updates, "updates"),
            ("publish", self.publish_updates, "updates"),
            ("evaluate", self.evaluate_samples, "samples"),
        ):
            if not count > 0:
                raise ValueError(f"{verb} every {count} {unit}: expected a positive number")
        for verb, seconds in (("evaluate", self.evaluate_seconds), ("save", self.save_seconds)):
            if not seconds >= 0:
                raise ValueError(f"{verb} every {seconds} seconds: expected a number of 0 or more")


@dataclass
class Progress:
    """What a run has spent so far, in all its bits together."""

    updates: int = 0
    samples: int = 0
    seconds: float = 0.0
    """Wall-clock."""
    cpu_seconds: float = 0.0
    """Of all processes of the run."""

    def share(self, budget: Budget) -> float:
        """Return the share of the budget that is spent."""
        return max(getattr(self, spent.name) / getattr(budget, spent.name) for spent in fields(budget))


class Clock:
    """Adds the time that passes to a run's progress."""

    def __init__(self, progress: Progress, worker_cpu_seconds: Callable[[], float]) -> None:
        """Count from now; `worker_cpu_seconds` returns the CPU time that other processes of the run have used."""
        self._progress, self._workers = progress, worker_cpu_seconds
        self._wall, self._cpu = time.monotonic(), self._used()

    def _used(self) -> float:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return usage.ru_utime + usage.ru_stime + self._workers()

    def tick(self) -> None:
        """Count the time since the last tick."""
        wall, cpu = time.monotonic(), self._used()
        self._progress.seconds += wall - self._wall
        self._progress.cpu_seconds += cpu - self._cpu
        self._wall, self._cpu = wall, cpu

    def skip(self) -> None:
        """Leave out the time since the last tick: an evaluation is no training."""
        self._wall, self._cpu = time.monotonic(), self._used()


class Meter:
    """Means of what updates return."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: Mapping[str, float]) -> None:
        """Add the numbers of one update; those that are not finite are left out."""
        for name, value in values.items():
            number = float(value)
            if math.isfinite(number):
                self._sums[name] = self._sums.get(name, 0.0) + number
                self._counts[name] = self._counts.get(name, 0) + 1

    def __bool__(self) -> bool:
        """Tell whether an update added something since the last call of `take`."""
        return bool(self._counts)

    def take(self) -> dict[str, float]:
        """Return the means since the last call."""
        means = {name: total / self._counts[name] for name, total in self._sums.items()}
        self._sums.clear()
        self._counts.clear()
        return means
