"""Train state estimator and control termination together from recorded bags (paper C.1, C.4).

    python -m mujoban_estimator.train --bags bags/one bags/two --run runs/estimator --steps 20000

A run that is started again with the same directory goes on where it stopped.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mujoban_core.files import digest
from mujoban_core.program import read_options, run_command
from mujoban_core.threads import set_threads
from mujoban_estimator.bag_source import BagSource, Reading
from mujoban_estimator.bag_stream import TOPICS
from mujoban_estimator.data import Batch
from mujoban_estimator.learner import EstimatorLearner, TrainConfig
from mujoban_msgs_py.bags.training import (
    bags_digest,
    find_bags,
    open_training_bag,
    require_about,
    require_training_seeds,
    require_untested,
)
from mujoban_rl.engine import Budget, Cadence, Trainer
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import provenance

PROG = "mujoban_estimator.train"


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
    """Folder that receives estimator.safetensors and termination.safetensors; `weights` in the run's by default."""
    start: Path | None = None
    """Folder with weights of both modules to start a new run from."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    seconds: float | None = None
    """Stop, with a checkpoint, after this time."""
    threads: int = 1
    """Threads of the networks."""
    workers: int = 1
    """Processes that read bags: 1 beside the steps, 0 to read between them, several to read all bags before them."""
    evaluate_every: int = 1000
    """Steps between evaluations."""
    save_every: float = 120.0
    """Seconds between checkpoints."""
    device: str = "cpu"
    """Device that computes: cpu or cuda."""
    skip_damaged: bool = False
    """Leave damaged parts of bags out instead of refusing them."""
    allow_test_seeds: bool = False
    """Learn also from episodes whose levels are not for training."""


def make_trainer(options: Options) -> Trainer[Batch]:
    """Check the bags and make, or resume, the run.

    Raises:
        ValueError: if a bag, the configuration or the run directory is not what is expected.
    """
    config = options.config
    set_threads(options.threads)
    bags, validation = find_bags(options.bags), find_bags(options.validation)
    worlds = set[str]()
    for path in (*bags, *validation):
        bag = open_training_bag(path, TOPICS, skip_damaged=options.skip_damaged)
        if path in validation:
            require_untested(bag)
        if path in bags and not options.allow_test_seeds:
            require_training_seeds(bag)
        require_about(bag, {"body": config.learner.estimator.body}, "--learner.estimator.{}")
        worlds.add(bag.about.get("world", "not stated"))
    learner = EstimatorLearner(
        config, device=options.device, validation=validation, skip_damaged=options.skip_damaged, out=options.out
    )
    if options.start is not None:
        learner.start_from(options.start)
    reading = Reading(
        bags, config.learner.estimator.body, config.streams, config.length, config.seed,
        skip_damaged=options.skip_damaged, allow_test_seeds=options.allow_test_seeds,
    )  # fmt: skip
    start = None if options.start is None else _digests(options.start)
    directory = RunDirectory(options.run, config, beside={"start": start})
    every = options.evaluate_every * config.streams * config.length
    record = {
        **provenance(),
        "data": [p.name for p in options.bags],
        "bags": len(bags),
        "bags_digest": bags_digest(bags),
        "start": start,
        "world": ", ".join(sorted(worlds)),
        "training": asdict(config),
    }
    source = BagSource(reading, options.workers)
    trainer = Trainer(
        directory,
        learner,
        source,
        Budget(updates=config.steps, cpu_seconds=config.cpu_seconds, seconds=config.horizon_seconds),
        Cadence(
            log_updates=50, evaluate_samples=every, save_seconds=options.save_every,
            evaluate_first=options.start is not None,
        ),
        record=record,
    )
    if not trainer.complete:
        source.read_all()
    return trainer


def _digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the weights in a folder, by module."""
    return {role: digest(folder / f"{role}.safetensors") for role in ("estimator", "termination")}


def main(command_line: Sequence[str] | None = None, prog: str = PROG) -> int:
    """Run the command."""
    options = read_options(Options, command_line, prog, __doc__)
    make_trainer(options).run(limit_seconds=options.seconds)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
