"""Expert iteration on the engine: the learner behind `mujoban_planner.search_lessons`, and a run of it.

Shapes: B batch.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mujoban_planner.growth import start_from
from mujoban_planner.imitation import ImitationConfig, imitation_loss
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.samples import Batch
from mujoban_planner.search_lessons import SearchConfig, SearchLessons
from mujoban_planner.uncertainty import blur, hide_unseen
from mujoban_planner.validation import NetworkConfig, solve_rates
from mujoban_rl.engine import Budget, Cadence, Learner, Scalars, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, guarded_step, moving_average, warm_up_cosine
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import provenance, save_weights


@dataclass(frozen=True)
class ExpertIterationConfig(NetworkConfig):
    """What defines a run of expert iteration."""

    blocks: int = 6
    """Residual blocks (residual)."""
    search: SearchConfig = field(default_factory=SearchConfig)
    batch_size: int = 256
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-3
    warm_up: float = 0.01
    """Share of the budget in which the learning rate rises."""
    plan_weight: float = 1.0
    """Weight of the plan map in the loss."""
    dead_weight: float = 1.0
    """Weight of the verdicts in the loss."""
    ema: float = 0.999
    """Decay of the averaged weights, which are what searches, is played and shipped."""
    noise: float = 0.0
    """Share of a batch whose abstract states are blurred, as estimates are."""
    hidden: float = 0.0
    """Share of a batch that shows only what the robot may have seen so far."""
    init: str | None = None
    """Weights to start from: of the same or fewer channels and blocks."""
    cpu_seconds: float = 10_800.0
    """CPU seconds after which the run is complete; the learning rate falls until then. Two cores have so many in 90
    minutes."""
    updates: float = 1e9
    """Updates after which it is complete."""
    seed: int = 0


class ExpertLearner(Learner[Batch]):
    """A planner network that learns from labelled states by `imitation_loss`."""

    def __init__(self, config: ExpertIterationConfig) -> None:
        """Build the network, or start from another."""
        self.config = config
        torch.manual_seed(config.seed)  # the initial weights
        self.network = config.build()
        if config.init is not None:
            start_from(self.network, Path(config.init))
        self.network.lay_out()
        self._average = moving_average(self.network, config.ema, warm_up=True)
        self._adam = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, (0.9, 0.98), weight_decay=config.weight_decay, fused=True
        )
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(config.warm_up))
        self._rng = np.random.default_rng([config.seed, 5])
        self._generator = torch.Generator().manual_seed(config.seed)
        self._loss = ImitationConfig(plan_weight=config.plan_weight, dead_weight=config.dead_weight)

    @property
    def average(self) -> LearnedPlanner:
        """The averaged network."""
        assert isinstance(self._average.module, LearnedPlanner)
        return self._average.module

    @property
    def modules(self) -> Mapping[str, torch.nn.Module]:
        """Network and average."""
        return {"network": self.network, "average": self._average}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """AdamW."""
        return {"adamw": self._adam}

    def state(self) -> State:
        """Return the random states."""
        return State({"rng": self._rng.bit_generator.state}, {"generator": self._generator.get_state()})

    def restore(self, state: State) -> None:
        """Take over the random states."""
        self._rng.bit_generator.state = state.values["rng"]
        self._generator.set_state(state.tensors["generator"])

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> Scalars:
        """Take a gradient step."""
        self._schedule.follow(progress)
        shown = hide_unseen(blur(batch.state, self.config.noise, self._generator), self.config.hidden, self._rng)
        with torch.autocast("cpu", torch.bfloat16):
            loss, parts = imitation_loss(self.network, batch._replace(state=shown), self._loss)
        if guarded_step(loss, [self._adam], guard, clip=1.0) is not None:
            self._average.update_parameters(self.network)
        return {f"train/{k}": float(v) for k, v in parts.items()}

    def weights(self) -> Mapping[str, Tensor]:
        """Return the averaged weights, which guide the searches."""
        return self.average.state_dict()

    def evaluate(self) -> Scalars:
        """Return the solve rates of the averaged weights, alone, on held-out levels."""
        return solve_rates(self.average, reduced_precision=True)

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the averaged weights with their record."""
        save_weights(directory.path / "planner.safetensors", self.average, self.average.config, record)


def expert_iteration(config: ExpertIterationConfig, directory: Path, cadence: Cadence) -> Trainer[Batch]:
    """Return the trainer of a run of expert iteration, resumed if there is one in the directory."""
    learner = ExpertLearner(config)
    guide = copy.deepcopy(learner.network)
    source = SearchLessons(guide, config.search, config.batch_size, config.seed)
    record = {
        **provenance(),
        "method": "expert-iteration",
        "training": asdict(config),
        "data": "solutions and verdicts of the planner's own search on generated levels, training seeds; no solver",
    }
    budget = Budget(cpu_seconds=config.cpu_seconds, updates=config.updates)
    return Trainer(RunDirectory(directory, config), learner, source, budget, cadence, record=record)
