"""Train state estimator and control termination together from recorded bags (paper C.1, C.4).

    python -m mujoban_estimator.train --bags bags/one bags/two --run runs/estimator --steps 20000

A run that is started again with the same directory goes on where it stopped.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch.utils.data import DataLoader, IterableDataset

from mujoban_core.bodies import get_body
from mujoban_estimator.bag_stream import ReadReport, endless, find_bags, open_checked
from mujoban_estimator.data import Batch, Batcher
from mujoban_estimator.evaluate import evaluate
from mujoban_estimator.learner import Learner, LearnerConfig
from mujoban_rl.limits import NaNGuard, StopSignal, TimeLimit
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.training_log import TrainingLog
from mujoban_rl.weights import load_weights, provenance, save_weights


@dataclass(frozen=True)
class TrainConfig:
    """What must not change between the bits of a run."""

    learner: LearnerConfig = field(default_factory=LearnerConfig)
    streams: int = 4
    """Bags that are read side by side; each is a row of the batch, whose memory goes on from step to step."""
    length: int = 64
    """Ticks of a stretch, a multiple of `update_every`."""
    steps: int = 20_000
    """Steps of the learning-rate schedule."""
    learning_rate: float = 1.5e-3
    warm_up: int = 50
    final_rate: float = 0.03
    """Learning rate at the last step, as a share of `learning_rate`; it falls linearly."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Reject what contradicts itself."""
        every = self.learner.estimator.update_every
        if self.length < 1 or self.length % every:
            raise ValueError(f"length is {self.length}: expected a multiple of update_every, {every}")
        if self.streams < 1 or self.steps < 1:
            raise ValueError(f"{self.streams} streams, {self.steps} steps: expected at least 1")


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    bags: tuple[Path, ...]
    """Bags, or folders of bags, to learn from."""
    run: Path = Path("runs/estimator")
    """Directory of the run; an existing one is resumed."""
    validation: tuple[Path, ...] = ()
    """Bags to evaluate on; none: no evaluation."""
    out: Path | None = None
    """Folder that receives estimator.safetensors and termination.safetensors at the end."""
    start: Path | None = None
    """Folder with weights of both modules to start a new run from."""
    config: TrainConfig = field(default_factory=TrainConfig)
    seconds: float | None = None
    """Stop, with a checkpoint, after this time."""
    threads: int = 1
    workers: int = 1
    """Processes that read bags; 0 reads between the steps."""
    evaluate_every: int = 1000
    save_every: int = 250
    device: str = "cpu"
    skip_damaged: bool = False
    """Leave damaged parts of bags out instead of refusing them."""
    allow_test_seeds: bool = False
    """Learn also from episodes whose seeds are reserved for tests."""


class BagBatches(IterableDataset[Batch]):
    """Endless batches from bags, for a reading process."""

    def __init__(self, options: Options, bags: list[Path], salt: int) -> None:
        """Read from `bags`; `salt` makes a resumed run go on with another order."""
        super().__init__()
        self._options, self._bags, self._salt = options, bags, salt

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches of consecutive stretches."""
        options, config = self._options, self._options.config
        generators = np.random.default_rng([config.seed, self._salt]).spawn(config.streams)
        streams = [
            endless(
                self._bags, config.length, rng, ReadReport(),
                skip_damaged=options.skip_damaged, allow_test_seeds=options.allow_test_seeds,
            )
            for rng in generators
        ]  # fmt: skip
        return iter(Batcher(streams, config.length, get_body(config.learner.estimator.body)))


def _as_is(batch: Batch) -> Batch:
    return batch


def learning_rate(step: int, config: TrainConfig) -> float:
    """Return the learning rate of a step: linear warm-up, then linear decay."""
    decay = max(config.final_rate, 1.0 - step / config.steps)
    return config.learning_rate * min(1.0, (step + 1) / config.warm_up) * decay


class Trainer:
    """A training run."""

    def __init__(self, options: Options) -> None:
        """Check the bags and make, or resume, the run.

        Raises:
            ValueError: if a bag, the configuration or the run directory is not what is expected.
        """
        self.options, config = options, options.config
        torch.set_num_threads(options.threads)
        torch.manual_seed(config.seed)
        self.bags = find_bags(options.bags)
        self.validation = find_bags(options.validation)
        for path in (*self.bags, *self.validation):
            open_checked(path, skip_damaged=options.skip_damaged)
        self.learner = Learner(config.learner, config.streams, np.random.default_rng(config.seed), options.device)
        self.optimiser = torch.optim.Adam(self.learner.parameters(), config.learning_rate)
        self.run = RunDirectory(options.run, asdict(config))
        self.guard = NaNGuard()
        self.metrics: dict[str, Any] = {}
        snapshot = self.run.load(modules=self._modules, optimisers={"adam": self.optimiser})
        self.step = 0 if snapshot is None else snapshot.step
        if snapshot is not None:
            self.learner.rng.bit_generator.state = snapshot.extra["rng"]
            self.metrics = snapshot.extra["metrics"]
        elif options.start is not None:
            self._start_from(options.start)

    @property
    def _modules(self) -> dict[str, torch.nn.Module]:
        return {"estimator": self.learner.estimator, "termination": self.learner.termination}

    def _start_from(self, folder: Path) -> None:
        """Begin with the weights of former modules; the ResNet is the estimator's."""
        for name, module in reversed(self._modules.items()):
            module.load_state_dict(load_weights(type(module), folder / f"{name}.safetensors").state_dict())

    def train(self) -> None:
        """Train until the steps are done, the time is up or a signal asks to stop; then save."""
        options, config = self.options, self.options.config
        loader = DataLoader(
            BagBatches(options, self.bags, self.step),
            batch_size=None,
            num_workers=options.workers,
            collate_fn=_as_is,  # pyright: ignore[reportArgumentType] - one batch at a time, not a list
        )
        totals: dict[str, list[float]] = {}
        with (
            TrainingLog(self.run, total=config.steps, initial=self.step) as log,
            StopSignal() as stop,
        ):
            limit = TimeLimit(options.seconds)
            for batch in loader:
                if self.step >= config.steps or stop.requested or limit.reached:
                    break
                for name, value in self._update(batch).items():
                    totals.setdefault(name, []).append(value)
                self.step += 1
                log.advance()
                if self.step % 50 == 0:
                    log.scalars(self.step, {f"train/{k}": float(np.mean(v)) for k, v in totals.items()})
                    totals.clear()
                if self.step % options.save_every == 0:
                    self.save()
                if self.validation and self.step % options.evaluate_every == 0:
                    self._evaluate(log)
            if self.validation:
                self._evaluate(log)
        self.save()

    def _update(self, batch: Batch) -> dict[str, float]:
        """Take one gradient step; return the parts of the loss."""
        config = self.options.config
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.step, config)
        self.optimiser.zero_grad()
        loss, parts = self.learner.loss(batch)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.learner.parameters(), config.clip)
        if self.guard.accept(loss.detach(), norm):
            self.optimiser.step()
        return {name: float(value) for name, value in parts.items()}

    def _evaluate(self, log: TrainingLog) -> None:
        rates = evaluate(self.learner.estimator, self.learner.termination, self.validation)
        # A rate of nothing is not a number, which JSON does not know.
        self.metrics = {name: round(rate, 5) for name, rate in rates.items() if math.isfinite(rate)}
        log.scalars(self.step, {f"valid/{k}": v for k, v in self.metrics.items()})
        log.message(f"step {self.step}: " + ", ".join(f"{k} {v}" for k, v in self.metrics.items()))

    def save(self) -> None:
        """Write a checkpoint and, if asked for, the weights of both modules."""
        extra = {"rng": self.learner.rng.bit_generator.state, "metrics": self.metrics}
        self.run.save(self.step, modules=self._modules, optimisers={"adam": self.optimiser}, extra=extra)
        if self.options.out is None:
            return
        record = {
            **provenance(),
            "data": [p.name for p in self.options.bags],
            "bags": len(self.bags),
            "steps": self.step,
            "training": asdict(self.options.config),
            "metrics": self.metrics,
        }
        for name, module in (("estimator", self.learner.estimator), ("termination", self.learner.termination)):
            save_weights(self.options.out / f"{name}.safetensors", module, module.hyperparameters(), record)


def main() -> None:
    """Run the command."""
    try:
        Trainer(tyro.cli(Options, prog="mujoban_estimator.train", description=__doc__)).train()
    except (ValueError, OSError) as error:
        print(f"train: error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
