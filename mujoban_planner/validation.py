"""The network a trainer builds, and how it measures it: held-out levels, the same in every evaluation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final, Literal

from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner, ThinkingPlanner
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.play import play
from mujoban_sokoban.generator import VALIDATION_SEEDS, generate_batch
from mujoban_sokoban.levels import LevelBatch

_FIRST_SEED: Final = 9_000_000
_EPISODES: Final = {5: 256, 4: 64, 1: 64}
"""Difficulty -> episodes of a periodic evaluation."""


Shares = tuple[float, float, float, float, float]
"""Shares of difficulties 1 to 5 among levels."""


def difficulty_shares(shares: Shares) -> dict[int, float]:
    """Return shares by difficulty."""
    return dict(enumerate(shares, 1))


@dataclass(frozen=True)
class NetworkConfig:
    """What defines a planner network."""

    architecture: Literal["residual", "thinking", "recurrent"] = "residual"
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
    """Spread over the board by the rules where the robot can walk and boxes be pushed; the paper's network does not."""

    judge: bool = True
    """Judge each push where the box is (with propagation)."""

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
    seeds = range(_FIRST_SEED, _FIRST_SEED + n)
    assert seeds[0] in VALIDATION_SEEDS and seeds[-1] in VALIDATION_SEEDS
    return generate_batch(difficulty, seeds)


def success_rates(planner: LearnedPlanner) -> dict[str, float]:
    """Return the share of held-out levels that a planner solves alone, by difficulty."""
    rates = {}
    for difficulty, n in _EPISODES.items():
        game = play(planner, validation_levels(difficulty, n), reduced_precision=True)
        rates[f"success_rate/{difficulty}"] = float(game.solved.mean())
    return rates
