"""Several methods one after the other, each from the weights of the one before: `... mujoban_planner.train stages`.

What ends up as their planner is the best of all stages on held-out levels: each keeps what it begins with while what it
makes is worse. Imitation, whose lessons show estimates, hands on its last.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_core.files import write_atomically
from mujoban_core.program import read_changes
from mujoban_core.ranges import check_counts, check_positive
from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.growth import beginning
from mujoban_planner.imitation import ImitationConfig, LearnerConfig, check_init_share, imitation
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
_OF_BAGS: Final = {"bags", "bag_share", "bag_estimates"}
"""What methods by themselves are told of recorded bags."""


class _Place(NamedTuple):
    """Where a stage trains, what it begins with, and how often it logs and evaluates."""

    run: Path
    cadence: Cadence
    actors: ActorOptions
    device: str
    init: str | None
    """Weights that it begins with."""


def _expert_iteration(config: ExpertIterationConfig, place: _Place) -> Trainer[Any]:
    config = replace(config, init=place.init)
    return expert_iteration(config, place.run, place.cadence, place.actors, device=place.device)


def _imitation(config: ImitationConfig, place: _Place) -> Trainer[Any]:
    config = replace(config, init=place.init)
    return imitation(config, place.run, place.cadence, device=place.device, actors=place.actors)


def _mpo(config: MPOConfig, place: _Place) -> Trainer[Any]:
    cadence, init = replace(place.cadence, **MPO_PACE), None if place.init is None else Path(place.init)
    return reinforcement(config, place.run, cadence, device=place.device, actors=place.actors, init=init)


def _mpo_pushes(config: PushMPOConfig, place: _Place) -> Trainer[Any]:
    return push_mpo(replace(config, init=place.init), place.run, place.cadence, place.actors)


def _ppo(config: PushPPOConfig, place: _Place) -> Trainer[Any]:
    cadence = replace(place.cadence, **PPO_PACE)
    return push_ppo(replace(config, init=place.init), place.run, cadence, place.actors)


class _Method(NamedTuple):
    """How a stage may train."""

    config: Any
    """Its configuration, where a stage has no options of its own."""
    trainer: Callable[[Any, _Place], Trainer[Any]]


METHODS: Final[Mapping[str, _Method]] = {
    "expert-iteration": _Method(ExpertIterationConfig(), _expert_iteration),
    "imitation": _Method(ImitationConfig(horizon_samples=1e12), _imitation),
    "mpo": _Method(MPOConfig(), _mpo),
    "mpo-pushes": _Method(PushMPOConfig(), _mpo_pushes),
    "ppo": _Method(PushPPOConfig(), _ppo),
}


@dataclass(frozen=True)
class StagesConfig(NetworkConfig):
    """What defines a run of several methods."""

    channels: int = 48
    """Channels of the network."""
    blocks: int = 6
    """Residual blocks (residual, thinking)."""
    stages: tuple[str, ...] = ("expert-iteration=0.7", "mpo-pushes=0.3")
    """Methods in their order, each with its share of the time: expert-iteration, imitation, mpo, mpo-pushes, ppo.
    Options of the method may follow in the same text: "ppo=0.2 --learning-rate 3e-4"."""
    init: str | None = None
    """Weights that the first stage starts from: of the same or fewer channels and blocks."""
    cpu_seconds: float = 10_800.0
    """CPU seconds of all together."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject networks and budgets of nothing, no method, share or option, and what a later stage cannot have."""
        super().__post_init__()
        check_counts(self, "seed", least=0)
        check_positive(self, "cpu_seconds")
        (_, first), *_ = self.parsed
        if isinstance(first, LearnerConfig):  # the others begin with what the one before made
            check_init_share(replace(first, init=self.init))

    @property
    def parsed(self) -> list[tuple[str, Any]]:
        """Methods with their configurations, but for the weights that they begin with; shares are those of the time.

        Raises:
            ValueError: If a method is unknown, a share is not positive, an option is no stage's or out of its range, or
                a stage cannot have the network of the whole run or has a seed without levels.
        """
        read = [_read_stage(text) for text in self.stages]
        if not read:
            raise ValueError("--stages: expected at least one METHOD=SHARE")
        total = sum(weight for _, weight, _ in read)
        stages = []
        for i, (text, (method, weight, own)) in enumerate(zip(self.stages, read, strict=True)):
            seed = len(read) * self.seed + i  # each stage has levels of its own
            whole = asdict(self.network) | {"seed": seed, "cpu_seconds": weight / total * self.cpu_seconds}
            try:
                stages.append((method, replace(own, **whole)))
            except ValueError as error:
                raise ValueError(f"--stages {text}: {error}") from None
        return stages


_WHOLE: Final = {
    *(option.name for settings in (StagesConfig, ActorOptions) for option in fields(settings)),
    *("run", "device", "seconds", "threads", "evaluate_every", "evaluate_samples", "save_every"),
}
"""What the whole run is told, and no stage."""


def _read_stage(text: str) -> tuple[str, float, Any]:
    """Return the method, the weight of its share, and the configuration with options of its own that a text tells of.

    Raises:
        ValueError: If it is not METHOD=SHARE, options behind it.
    """
    try:
        first, *options = shlex.split(text) or [""]
    except ValueError as error:
        raise ValueError(f"--stages {text}: {error}, expected words as a shell splits them") from None
    method, _, share = first.partition("=")
    try:
        weight = float(share)
    except ValueError:
        weight = math.nan
    if method not in METHODS or not 0.0 < weight < math.inf:
        raise ValueError(f"--stages {text}: expected METHOD=SHARE with a method among {', '.join(METHODS)}")
    try:
        return method, weight, _with_options(method, options)
    except ValueError as error:
        raise ValueError(f"--stages {text}: {error}") from None


def _with_options(method: str, options: Sequence[str]) -> Any:
    """Return the configuration of a method with options of a stage's own.

    Raises:
        ValueError: If one is unknown, out of its range, or no stage's.
    """
    for option in (word.partition("=")[0] for word in options if word.startswith("--")):
        name = option.removeprefix("--").replace("-", "_").removeprefix("no_")
        if name in _WHOLE:
            raise ValueError(f"{option} is the whole run's, expected outside of a stage's text")
        if name in _OF_BAGS:
            raise ValueError(f"{option} is of bags, expected none, as no stage reads any")
    own = METHODS[method].config
    return read_changes(own, options, f"what `train {method} --help` lists as config options") if options else own


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
    for i, (method, settings) in enumerate(config.parsed, 1):
        folders.append(directory / f"{i}_{method}")
        # What it begins with counts as a product: a stage that only makes it worse leaves it as it is.
        judging = replace(cadence, evaluate_first=cadence.evaluate_first or init is not None)
        trainer = METHODS[method].trainer(settings, _Place(folders[-1], judging, actors, device, init))
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
    write_atomically(target, (folders[-1] / _PRODUCT).read_bytes())
    cost = {name: sum(record.get(name) or 0 for record in records) for name in _COSTS}
    method = " then ".join(record["method"] for record in records)
    record = {**records[-1], **cost, "method": method, "stages": told}
    write_atomically(target.with_suffix(".json"), (json.dumps(record, indent=2) + "\n").encode())
