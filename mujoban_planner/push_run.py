"""What runs of reinforcement learning over pushes have in common."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from mujoban_core.ranges import check_not_negative, check_shares
from mujoban_planner.growth import beginning
from mujoban_planner.push_policy import Anchor, PushPolicy
from mujoban_planner.seed_streams import LEVELS, check_seed
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.engine import Budget
from mujoban_rl.weights import lineage, origin, provenance


@dataclass(frozen=True)
class PushRunConfig(NetworkConfig):
    """What defines a run, whatever the method."""

    channels: int = 32
    """Channels of the network."""
    blocks: int = 4
    """Residual blocks (residual)."""
    init: str | None = None
    """Weights to start from: of the same or fewer channels and blocks."""
    cpu_seconds: float = 10_800.0
    """CPU seconds after which the run is complete; the learning rate falls until then. Two cores have so many in 90
    minutes."""
    updates: float = 1e9
    """Updates after which it is complete."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""
    anchor: float = 1.0
    """Of a run that starts from weights: how much it counts that heads which it does not teach go on saying what they
    said; 0 lets them drift."""
    anchored: float = 0.25
    """Share of a batch's states in which they are asked."""

    def __post_init__(self) -> None:
        """Reject networks that pushes cannot be taught, seeds that there are not, and budgets of nothing."""
        super().__post_init__()
        if not self.propagation:
            raise ValueError("propagation is False: expected True, by which decisions follow the push head")
        check_seed(self.seed, LEVELS)
        check_not_negative(self, "anchor")
        check_shares(self, "anchored")
        _ = self.budget

    @property
    def budget(self) -> Budget:
        """When the run is complete."""
        return Budget(cpu_seconds=self.cpu_seconds, updates=self.updates)


def starting_policy(config: PushRunConfig) -> PushPolicy:
    """Return the policy that a run starts with."""
    torch.manual_seed(config.seed)  # the initial weights
    return PushPolicy(beginning(config, config.init), untaught=config.init is None)


def starting_anchor(config: PushRunConfig, policy: PushPolicy) -> Anchor | None:
    """Return what holds a policy that has learned nothing yet to its planner; None if no weights were given, or 0."""
    return Anchor(policy.planner, config.anchor, config.anchored) if config.init is not None and config.anchor else None


def training_record(method: str, config: PushRunConfig) -> dict[str, Any]:
    """Return what the weights' record says of a run."""
    data = lineage("own play of generated levels, training seeds, without a solver", config.init)
    return {**provenance(), "method": method, "training": asdict(config), "init": origin(config.init), "data": data}
