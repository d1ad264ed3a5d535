"""Several methods one after the other, each from the weights of the one before: `... mujoban_planner.train stages`.

What ends up as their planner is the best of all stages on held-out levels: each keeps what it begins with while what it
makes is worse. Imitation, whose lessons show estimates, hands on its last.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_core.files import write_atomically
from mujoban_core.ranges import check_counts, check_positive
from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.growth import beginning
from mujoban_planner.imitation import ImitationConfig, imitation
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PPO_PACE, PushPPOConfig, push_ppo
from mujoban_planner.reinforcement import MPO_PACE, MPOConfig, reinforcement
from mujoban_planner.validation import NetworkConfig
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
    device: str


class _Settings(NamedTuple):
    """What all methods are told."""

    network: NetworkConfig
    init: str | None
    seed: int
    cpu_seconds: float

    @property
    def options(self) -> dict[str, Any]:
        """All of it, as options of a method's configuration."""
        return asdict(self.network) | {"init": self.init, "seed": self.seed, "cpu_seconds": self.cpu_seconds}


def _expert_iteration(settings: _Settings, place: _Place) -> Trainer[Any]:
    config = ExpertIterationConfig(**settings.options)
    return expert_iteration(config, place.run, place.cadence, place.actors, device=place.device)


def _imitation(settings: _Settings, place: _Place) -> Trainer[Any]:
    config = ImitationConfig(**settings.options, horizon_samples=1e12)
    return imitation(config, place.run, place.cadence, device=place.device, actors=place.actors)


def _mpo(settings: _Settings, place: _Place) -> Trainer[Any]:
    options = settings.options
    init = options.pop("init")
    return reinforcement(
        MPOConfig(**options),
        place.run,
        replace(place.cadence, **MPO_PACE),
        device=place.device,
        actors=place.actors,
        init=None if init is None else Path(init),
    )


def _mpo_pushes(settings: _Settings, place: _Place) -> Trainer[Any]:
    return push_mpo(PushMPOConfig(**settings.options), place.run, place.cadence, place.actors)


def _ppo(settings: _Settings, place: _Place) -> Trainer[Any]:
    cadence = replace(place.cadence, **PPO_PACE)
    return push_ppo(PushPPOConfig(**settings.options), place.run, cadence, place.actors)


METHODS: Final[Mapping[str, Callable[[_Settings, _Place], Trainer[Any]]]] = {
    "expert-iteration": _expert_iteration,
    "imitation": _imitation,
    "mpo": _mpo,
    "mpo-pushes": _mpo_pushes,
    "ppo": _ppo,
}


@dataclass(frozen=True)
class StagesConfig(NetworkConfig):
    """What defines a run of several methods."""

    channels: int = 48
    """Channels of the network."""
    blocks: int = 6
    """Residual blocks (residual, thinking)."""
    stages: tuple[str, ...] = ("expert-iteration=0.7", "mpo-pushes=0.3")
    """Methods in their order, each with its share of the time: expert-iteration, imitation, mpo, mpo-pushes, ppo."""
    init: str | None = None
    """Weights that the first stage starts from: of the same or fewer channels and blocks."""
    cpu_seconds: float = 10_800.0
    """CPU seconds of all together."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Reject networks of nothing, budgets of nothing, and what is no method or no share."""
        super().__post_init__()
        check_counts(self, "seed", least=0)
        check_positive(self, "cpu_seconds")
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
    config: StagesConfig,
    directory: Path,
    cadence: Cadence,
    actors: ActorOptions,
    seconds: float | None = None,
    *,
    device: str = "cpu",
) -> bool:
    """Run, or go on with, all stages, each in a folder of its own; return whether all are complete.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory; the planner of the last stage, the best of all, is copied there.
        cadence: How often stages evaluate and save.
        actors: Where levels are searched or played, and lessons made.
        seconds: Wall-clock of this bit of the run.
        device: Device of the networks, in the methods that may have another than the CPU: all but those over pushes.

    Raises:
        RunError: If the directory belongs to another run.
        WeightsError: If the weights to start from are missing or damaged, or do not fit into the network.
    """
    if config.init is not None:
        beginning(config.network, config.init)  # fails before anything is written, if it does
    RunDirectory(directory, config)
    time, init = TimeLimit(seconds), config.init
    folders = []
    for i, (method, share) in enumerate(config.parsed, 1):
        folders.append(directory / f"{i}_{method}")
        seed = len(config.parsed) * config.seed + i - 1  # each stage has levels of its own
        settings = _Settings(config.network, init, seed, share * config.cpu_seconds)
        # What it begins with counts as a product: a stage that only makes it worse leaves it as it is.
        judging = replace(cadence, evaluate_first=cadence.evaluate_first or init is not None)
        trainer = METHODS[method](settings, _Place(folders[-1], judging, actors, device))
        product = folders[-1] / _PRODUCT
        if trainer.complete and trainer.judged and product.exists():
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
