"""Several methods one after the other, each from the weights of the one before: `... mujoban_planner.train stages`."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_core.files import write_atomically
from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.imitation import ImitationConfig, imitation
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence, Trainer
from mujoban_rl.limits import TimeLimit
from mujoban_rl.run_directory import RunDirectory

_PRODUCT: Final = "planner.safetensors"
_COSTS: Final = ("samples", "updates", "cpu_seconds")
_NOTED: Final = ("method", "digest", *_COSTS, "metrics")
"""What the record of the whole says of each stage."""


class _Place(NamedTuple):
    """Where a stage trains, and how often it logs and evaluates."""

    run: Path
    cadence: Cadence
    actors: ActorOptions


class _Settings(NamedTuple):
    """What all methods are told."""

    channels: int
    blocks: int
    init: str | None
    seed: int
    cpu_seconds: float


def _imitation(settings: _Settings, place: _Place) -> Trainer[Any]:
    common = settings._asdict()
    # Its budget is wall-clock: lessons are made in a process beside.
    horizon = common.pop("cpu_seconds") / 2.0
    config = ImitationConfig(**common, horizon_seconds=horizon, horizon_samples=1e12)
    return imitation(config, place.run, place.cadence, actors=ActorOptions("processes"))


METHODS: Final[Mapping[str, Callable[[_Settings, _Place], Trainer[Any]]]] = {
    "expert-iteration": lambda settings, place: expert_iteration(ExpertIterationConfig(**settings._asdict()), *place),
    "imitation": _imitation,
    "mpo-pushes": lambda settings, place: push_mpo(PushMPOConfig(**settings._asdict()), *place),
    "ppo": lambda settings, place: push_ppo(PushPPOConfig(**settings._asdict()), *place),
}


@dataclass(frozen=True)
class StagesConfig:
    """What defines a run of several methods."""

    stages: tuple[str, ...] = ("expert-iteration=0.7", "mpo-pushes=0.3")
    """Methods in their order, each with its share of the time: expert-iteration, imitation, mpo-pushes, ppo."""
    cpu_seconds: float = 10_800.0
    """CPU seconds of all together."""
    channels: int = 48
    """Channels of the network."""
    blocks: int = 6
    """Residual blocks."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Reject what is no method or no share."""
        _ = self.parsed

    @property
    def parsed(self) -> list[tuple[str, float]]:
        """Methods with their shares of the time, which add up to 1.

        Raises:
            ValueError: If a method is unknown or a share is not positive.
        """
        pairs = []
        for text in self.stages:
            method, _, share = text.partition("=")
            try:
                weight = float(share)
            except ValueError:
                weight = math.nan
            if method not in METHODS or not 0.0 < weight < math.inf:
                raise ValueError(f"--stages {text}: expected METHOD=SHARE with a method among {', '.join(METHODS)}")
            pairs.append((method, weight))
        if not pairs:
            raise ValueError("--stages: expected at least one METHOD=SHARE")
        total = sum(weight for _, weight in pairs)
        return [(method, weight / total) for method, weight in pairs]


def train_stages(
    config: StagesConfig, directory: Path, cadence: Cadence, actors: ActorOptions, seconds: float | None = None
) -> bool:
    """Run, or go on with, all stages, each in a folder of its own; return whether all are complete.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory; the planner of the last stage is copied there.
        cadence: How often stages evaluate and save.
        actors: Where levels are searched or played.
        seconds: Wall-clock of this bit of the run.

    Raises:
        RunError: If the directory belongs to another run.
    """
    RunDirectory(directory, config)
    time, init = TimeLimit(seconds), None
    folders = []
    for i, (method, share) in enumerate(config.parsed, 1):
        folders.append(directory / f"{i}_{method}")
        seed = len(config.parsed) * config.seed + i - 1  # each stage has levels of its own
        settings = _Settings(config.channels, config.blocks, init, seed, share * config.cpu_seconds)
        trainer = METHODS[method](settings, _Place(folders[-1], cadence, actors))
        product = folders[-1] / _PRODUCT
        if trainer.complete and product.exists():
            trainer.source.close()
        elif not trainer.run(limit_seconds=None if seconds is None else max(seconds - time.elapsed, 0.0)):
            return False
        init = str(product)
    _export(directory, folders)
    return True


def _export(directory: Path, folders: Sequence[Path]) -> None:
    """Copy the planner of the last stage, with a record that tells of all."""
    records = [json.loads((folder / _PRODUCT).with_suffix(".json").read_text()) for folder in folders]
    told = [{name: record.get(name) for name in _NOTED} for record in records]
    target = directory / _PRODUCT
    shutil.copyfile(folders[-1] / _PRODUCT, target)
    cost = {name: sum(record.get(name) or 0 for record in records) for name in _COSTS}
    method = " then ".join(record["method"] for record in records)
    record = {**records[-1], **cost, "method": method, "stages": told}
    write_atomically(target.with_suffix(".json"), (json.dumps(record, indent=2) + "\n").encode())
