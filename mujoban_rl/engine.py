"""The one training loop of the project: a `Learner` learns from the batches of a `Source`; a `Trainer` drives both.

What every training needs stands here once: limits, cadence, progress, learning curve, checkpoints, resuming, stop
signals. What is particular stands in two classes::

    class MyLearner(Learner[Batch]): ...   # networks, loss, optimisers: update(batch)
    class MySource(Source[Batch]): ...     # bags, lessons, replay fed by actors: next_batch()

    directory = RunDirectory(options.run, config)
    Trainer(directory, MyLearner(config), MySource(config), budget, cadence).run(limit_seconds=options.seconds)

A run that stops, by a limit or a signal, and goes on from its checkpoint ends as one that never stopped: to the bit on
a CPU, if learner and source keep everything that changes in `modules`, `optimisers` and `state`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from torch import Tensor, nn
from torch.optim import Optimizer

from mujoban_core import children
from mujoban_core.files import alone
from mujoban_core.program import say
from mujoban_core.signals import Interrupted, StopSignal
from mujoban_core.text import readable
from mujoban_rl.limits import Limits, NaNGuard, TimeLimit
from mujoban_rl.memory import keep_freed_memory
from mujoban_rl.progress import Budget, Cadence, Clock, Meter, Progress
from mujoban_rl.run_directory import RunDirectory, RunError
from mujoban_rl.state import State
from mujoban_rl.training_log import TrainingLog

BatchT = TypeVar("BatchT")
Scalars = Mapping[str, float]


class _Part(ABC):  # noqa: B024 - all of it has a default
    """What learners and sources have in common: all of it is restored from a checkpoint."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Everything with weights, by name."""
        return {}

    @property
    def optimisers(self) -> Mapping[str, Optimizer]:
        """Optimisers by name."""
        return {}

    def state(self) -> State:
        """Return what else changes during the run."""
        return State()

    def restore(self, state: State) -> None:  # noqa: B027 - most learners have no such state
        """Take over what `state` returned; modules and optimisers have been restored already."""


class Learner(_Part, Generic[BatchT]):
    """Networks, their loss and their optimisers."""

    @abstractmethod
    def update(self, batch: BatchT, progress: float, guard: NaNGuard) -> Scalars:
        """Learn from one batch and return what to log; the numbers of several updates are averaged.

        Every step of an optimiser goes through `mujoban_rl.optimise.guarded_step`, so that a batch that gives a
        number that is not finite leaves weights, dual variables and optimisers as they were.

        Args:
            batch: From the source.
            progress: Share of the budget that is spent, in [0, 1): what schedules depend on.
            guard: Decides whether a step is taken.
        """

    def weights(self) -> Mapping[str, Tensor]:
        """Return what actors need to act, by name; nothing by default."""
        return {}

    def evaluate(self) -> Scalars:
        """Return how good the product is on validation levels; must leave all states as they are.

        A signal cuts it short; then it is done again when the run goes on.
        """
        return {}

    @property
    def judges(self) -> bool:
        """Whether `evaluate` is its own."""
        return type(self).evaluate is not Learner.evaluate

    def restore_best(self, state: State) -> None:
        """Take over the part `best` of what `state` returned: all that a light copy keeps of it."""

    def folder(self, directory: RunDirectory) -> Path:
        """Return where `export` writes; by default the run's directory."""
        return directory.path

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the weights that the run is for, with their record, into `folder`."""


class Source(_Part, Generic[BatchT]):
    """Where batches come from."""

    samples: int = 0
    """Environment steps, or samples where there is no environment, so far: what learning curves are drawn against."""
    began: int = 0
    """Of these, those before it began: none, unless the run goes on from a light copy."""

    @abstractmethod
    def next_batch(self) -> BatchT | None:
        """Return the next batch, collecting experience where that is due; None when there is no more."""

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Hand the newest weights to those who act; `version` is the number of updates behind them."""

    def statistics(self) -> Scalars:
        """Return what to log of the experience since the last call."""
        return {}

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time that processes of this source have used so far in this bit of the run."""
        return 0.0

    def go_on(self, state: State) -> None:
        """Take over what a light copy holds of a state, so that nothing comes that came before."""

    def close(self) -> None:
        """End processes and close files."""


CARRIED: Final = (
    "progress", "metrics", "skipped", "due", "learner.best", "source.pool.next_stream", "source.pool.pool.next_stream",
    "source.lessons.pool.next_stream", "source.lessons.pool.pool.next_stream",
)  # fmt: skip
"""What a light copy of a checkpoint holds beside its modules (see `mujoban_rl.run_directory.copy_light`)."""
_GOES_ON: Final = "; the same command goes on from there"
_BAGS: Final = "bags_digest"
"""By what a record knows the bags again, wherever they lie; a light copy, which leaves them behind, may have others."""


class Trainer(Generic[BatchT]):
    """Drives a learner and a source until the budget is spent, in as many bits as it takes."""

    def __init__(
        self,
        directory: RunDirectory,
        learner: Learner[BatchT],
        source: Source[BatchT],
        budget: Budget,
        cadence: Cadence | None = None,
        *,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Restore the newest checkpoint of the directory, if there is one.

        Args:
            directory: The run's directory, opened with its configuration.
            learner: What learns.
            source: What it learns from.
            budget: When the run is complete.
            cadence: How often it logs, evaluates and saves.
            record: What the weights' record says beside progress and metrics (see `mujoban_rl.weights.provenance`).

        Raises:
            RunError: If there are checkpoints but none is intact, or they are of another kind of run, or learned from
                other bags than those of `record`.
        """
        self.directory, self.learner, self.source = directory, learner, source
        self.budget, self.cadence = budget, cadence or Cadence()
        self.progress = Progress()
        self.metrics: dict[str, float] = {}
        """Of the last evaluation."""
        self._record = dict(record or {})
        self._told: dict[str, Any] | None = None
        """The record that the checkpoint was saved with; a light copy has none."""
        self._guard = NaNGuard()
        self._published: dict[str, Tensor] | None = None
        self._version = 0
        self._evaluated: int | None = None
        self._due = self.cadence.evaluate_first
        """Whether the run begins with an evaluation: one that was asked for, or that a signal cut short."""
        self._restore()

    @property
    def complete(self) -> bool:
        """Whether the budget is spent."""
        return self.progress.share(self.budget) >= 1.0

    @property
    def judged(self) -> bool:
        """Whether no evaluation is due, such as one that a signal cut short."""
        return not self._due

    def run(
        self,
        *,
        limit_seconds: float | None = None,
        limit_samples: float = math.inf,
        limit_updates: float = math.inf,
    ) -> bool:
        """Train until the budget or a limit is spent, the source has no more, or a signal comes; then save.

        Where nothing is left to do, the weights are written once more, with the record that they had.

        Args:
            limit_seconds: Wall-clock seconds of this bit of the run.
            limit_samples: Samples of the whole run after which this bit ends; schedules follow the budget.
            limit_updates: Updates of the whole run after which this bit ends.

        Returns:
            Whether the run is complete.

        Raises:
            Interrupted: If a signal came; the run is saved then.
            InUseError: If another process trains in the run's directory.
            ValueError: If the limit of seconds is below 0 or no number.
        """
        children.end_with_parent()
        keep_freed_memory()
        samples = min(self.budget.samples, limit_samples)
        total = None if math.isinf(samples) else int(samples)
        limits = Limits(TimeLimit(limit_seconds), limit_samples, limit_updates)
        try:
            with (
                alone(self.directory.path),
                TrainingLog(self.directory, total=total, initial=self.progress.samples, unit="sample") as log,
                StopSignal(heard=lambda: say(f"{self.directory.path}: stopping after this update")) as stop,
            ):
                idle = self.complete and self.judged
                spent = self._loop(log, stop, limits)
                if idle:
                    self.learner.export(self.directory, self._told or self._told_now())
                else:
                    if not stop.requested and self._evaluated != self.progress.updates:
                        if self.learner.judges:
                            say(f"{self.directory.path}: judging what was learned; Ctrl-C puts it off")
                        self._evaluate(log, stop)
                    self.save()
            path, done = self.directory.path, f"after {readable(self.progress.samples)} samples"
            if stop.requested:
                say(f"{path}: interrupted {done}{_GOES_ON}")
                # Whoever waits for the command, such as make, is not to take what is half trained for done.
                stop.check()
            if not idle and spent:
                say(f"{path}: complete {done}: weights in {self.learner.folder(self.directory)}")
            elif not spent:
                say(f"{path}: stopped {done}{_GOES_ON if limits.time.reached else ''}")
        finally:
            self.source.close()
        return spent

    def _loop(self, log: TrainingLog, stop: StopSignal, limits: Limits) -> bool:
        """Train; return whether it ended because nothing is left to do."""
        cadence, progress, source = self.cadence, self.progress, self.source
        clock, meter = Clock(progress, source.worker_cpu_seconds), Meter()
        saved = evaluated = limits.time.elapsed
        if self._due:
            self._evaluate(log, stop)
            clock.skip()
        spent = True
        if not self.complete:
            self._publish(again=True)
        else:
            say(f"{self.directory.path}: complete after {readable(progress.samples)} samples; nothing is left to do")
        while not self.complete:
            if stop.requested or limits.reached(progress):
                spent = False
                break
            batch = source.next_batch()
            if batch is None:
                break
            meter.add(self.learner.update(batch, progress.share(self.budget), self._guard))
            before, progress.samples = progress.samples, source.samples
            progress.updates += 1
            clock.tick()
            log.advance(progress.samples - before)
            if progress.updates % cadence.publish_updates == 0:
                self._publish()
            if progress.updates % cadence.log_updates == 0:
                self._log(log, meter)
            due = progress.samples // cadence.evaluate_samples > before // cadence.evaluate_samples
            if due or limits.time.elapsed - evaluated > cadence.evaluate_seconds:
                self._evaluate(log, stop)
                clock.skip()
                evaluated = limits.time.elapsed
            if limits.time.elapsed - saved > cadence.save_seconds:
                saved = limits.time.elapsed
                self.save()
        if meter:
            self._log(log, meter)
        return spent

    def _log(self, log: TrainingLog, meter: Meter) -> None:
        """Log the updates and the experience since the last line."""
        log.scalars(self.progress.samples, {**meter.take(), **self.source.statistics(), **self._spent()})

    def _publish(self, *, again: bool = False) -> None:
        """Hand the newest weights to the source, or `again` those that it had when the run stopped."""
        if self._published is None or not again:
            self._published = {k: v.detach().clone() for k, v in self.learner.weights().items()}
            self._version = self.progress.updates
        self.source.publish(self._published, self._version)

    def _evaluate(self, log: TrainingLog, stop: StopSignal) -> None:
        self._due = True
        try:
            # Judging whole levels may take minutes, more than whoever stops a run waits before it is killed.
            with stop.immediate():
                scores = self.learner.evaluate()
        except Interrupted:
            return
        self._due, self._evaluated = False, self.progress.updates
        # A rate of nothing is not a number, which JSON does not know.
        self.metrics = {k: float(v) for k, v in scores.items() if math.isfinite(v)}
        if not self.metrics:
            return
        shown = ", ".join(f"{k} {readable(v)}" for k, v in self.metrics.items())
        line = f"{self.progress.samples:,} samples, {self.progress.cpu_seconds:,.0f} CPU s: {shown}"
        logged = {f"evaluation/{k}": v for k, v in self.metrics.items()}
        log.scalars(self.progress.samples, logged | self._spent(), line)

    def _spent(self) -> dict[str, float]:
        progress = self.progress
        return {
            "updates": progress.updates,
            "seconds": progress.seconds,
            "cpu_seconds": progress.cpu_seconds,
            "refused_updates": self._guard.skipped,
        }

    def save(self) -> None:
        """Write a checkpoint, and export the weights with their record."""
        parts = {"learner": self.learner, "source": self.source}
        published = State({"version": self._version}, self._published or {})
        state = State.of({name: part.state() for name, part in parts.items()} | {"published": published})
        record = self._told_now()
        self.directory.save(
            self.progress.updates,
            modules={f"{name}.{k}": v for name, part in parts.items() for k, v in part.modules.items()},
            optimisers={f"{name}.{k}": v for name, part in parts.items() for k, v in part.optimisers.items()},
            extra={
                "progress": vars(self.progress),
                "metrics": self.metrics,
                "skipped": self._guard.skipped,
                # What is complete is judged once more, also if the process is killed meanwhile.
                "due": self._due or (self.complete and self._evaluated != self.progress.updates),
                "record": record,
                "began": self.source.began,
                **state.values,
            },
            tensors=state.tensors,
        )
        self.learner.export(self.directory, record)

    def _told_now(self) -> dict[str, Any]:
        """Return what the record of the weights says now."""
        return {**self._record, **vars(self.progress), "metrics": self.metrics}

    def _take_over(self, record: Mapping[str, Any] | None) -> None:
        """Take over the record of a checkpoint, if it has one: it must be of the same bags."""
        self._told = None if record is None else dict(record)
        now = self._record.get(_BAGS)
        if record is not None and (then := record.get(_BAGS, now)) != now:
            raise RunError(
                f"{self.directory.path}: other bags than the run's (digest {then or 'none'} there, {now or 'none'} "
                "now): expected those, or another --run"
            )

    def _restore(self) -> None:
        parts = {"learner": self.learner, "source": self.source}
        snapshot = self.directory.load(
            modules={f"{name}.{k}": v for name, part in parts.items() for k, v in part.modules.items()},
            optimisers={f"{name}.{k}": v for name, part in parts.items() for k, v in part.optimisers.items()},
        )
        if snapshot is None:
            return
        self._take_over(snapshot.extra.get("record"))
        with self.directory.reading(snapshot.step):
            self.progress = Progress(**snapshot.extra["progress"])
            self.metrics = snapshot.extra["metrics"]
            self._guard.skipped = snapshot.extra["skipped"]
            self._due = snapshot.extra.get("due", False)
            state = State(snapshot.extra, snapshot.tensors)
            if snapshot.light:
                if "best" in snapshot.extra.get("learner", {}):
                    self.learner.restore_best(state.part("learner").part("best"))
                if "source" in snapshot.extra:
                    self.source.go_on(state.part("source"))
            else:
                for name, part in parts.items():
                    part.restore(state.part(name))
                published = state.part("published")
                self._published, self._version = published.tensors, published.values["version"]
        self.source.samples = self.progress.samples
        self.source.began = self.progress.samples if snapshot.light else snapshot.extra.get("began", 0)
