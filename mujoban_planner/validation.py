"""The network a trainer builds, and how it measures it: held-out levels, the same in every evaluation."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final, Literal, Self, cast, get_args

from mujoban_core.ranges import check_counts
from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner, ThinkingPlanner
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.play import play
from mujoban_rl.weights import WeightsError, read_record
from mujoban_sokoban.generator import PLANNER_SEEDS, generate_batch
from mujoban_sokoban.levels import LevelBatch

_EPISODES: Final = {5: 256, 4: 64, 1: 64}
"""Difficulty -> episodes of a periodic evaluation."""


Architecture = Literal["residual", "thinking", "recurrent"]

Shares = tuple[float, float, float, float, float]
"""Shares of difficulties 1 to 5 among levels."""


def check_mix(shares: Shares) -> None:
    """Raise ValueError unless these are shares of difficulties that levels can be drawn by."""
    if not all(0.0 <= share < math.inf for share in shares) or not sum(shares):
        raise ValueError(f"mix is {' '.join(map(str, shares))}: expected five shares from 0 on, not all 0")


def difficulty_shares(shares: Shares) -> dict[int, float]:
    """Return shares by difficulty."""
    return dict(enumerate(shares, 1))


@dataclass(frozen=True)
class NetworkConfig:
    """What defines a planner network."""

    architecture: Architecture = "residual"
    """Network."""
    channels: int = 64
    """Channels of the network."""
    blocks: int = 8
    """Residual blocks (residual, thinking)."""
    tied: int = 6
    """The last of these blocks, which are repeated (thinking)."""
    depth: int = 3
    """ConvLSTM layers (recurrent)."""
    repeats: int = 3
    """Repeats of the ConvLSTM layers (recurrent)."""
    propagation: bool = True
    """It spreads over the board by the rules where the robot can walk and boxes be pushed; the paper's network does
    not, nor does it with --no-propagation."""

    judge: bool = True
    """It judges each push where the box is (with propagation), unless --no-judge is given."""

    def __post_init__(self) -> None:
        """Reject networks of nothing."""
        check_counts(self, "channels", "blocks", "tied", "depth", "repeats")

    @classmethod
    def of(cls, weights: Path) -> Self:
        """Return the network of trained weights, by their record.

        Raises:
            WeightsError: If there is no record, or it is none of a planner.
        """
        record = read_record(weights)
        name = record["class"].removesuffix("Planner").lower()
        if name not in get_args(Architecture):
            raise WeightsError(f"{weights}: holds weights of {record['class']}, expected those of a planner")
        names = {f.name for f in fields(NetworkConfig)}
        sizes = {key: value for key, value in record["config"].items() if key in names}
        return cls(architecture=cast(Architecture, name), **({"judge": False} | sizes))

    def holding(self, smaller: NetworkConfig) -> NetworkConfig:
        """Return this network, or as much larger a one as can begin with weights of another (`growth.start_from`)."""
        ours = self.network
        if "recurrent" in (ours.architecture, smaller.architecture):
            return smaller
        ours = replace(
            ours, channels=max(ours.channels, smaller.channels), propagation=smaller.propagation, judge=smaller.judge
        )
        if smaller.architecture == "thinking":  # which blocks are repeated has to stay
            return replace(ours, architecture="thinking", blocks=smaller.blocks, tied=smaller.tied)
        return replace(ours, blocks=max(ours.blocks, smaller.blocks))

    @property
    def network(self) -> NetworkConfig:
        """The network alone."""
        return NetworkConfig(**{f.name: getattr(self, f.name) for f in fields(NetworkConfig)})

    def build(self) -> LearnedPlanner:
        """Return a new network."""
        if self.architecture == "recurrent":
            return RecurrentPlanner(self.channels, self.depth, self.repeats, self.propagation, self.judge)
        if self.architecture == "thinking":
            return ThinkingPlanner(self.channels, self.blocks, self.tied, self.propagation, self.judge)
        return ResidualPlanner(self.channels, self.blocks, self.propagation, self.judge)


def validation_levels(difficulty: int, n: int) -> LevelBatch:
    """Return `n` held-out levels."""
    assert n <= len(PLANNER_SEEDS)
    return generate_batch(difficulty, PLANNER_SEEDS[:n])


def success_rates(planner: LearnedPlanner) -> dict[str, float]:
    """Return the share of held-out levels that a planner solves alone, by difficulty."""
    rates = {}
    for difficulty, n in _EPISODES.items():
        game = play(planner, validation_levels(difficulty, n), reduced_precision=True)
        rates[f"success_rate/{difficulty}"] = float(game.solved.mean())
    return rates
