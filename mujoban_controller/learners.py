"""What a training run drives: one learner per stage, each with data to collect and updates to make.

A learner owns its task, replay and networks; `mujoban_controller.train` owns time, checkpoints and the log.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_controller.bag_sequences import BagSequences
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.distil import Collector, DistilConfig, Distiller
from mujoban_controller.drivers import Driver, PrivilegedDriver
from mujoban_controller.goal_task import GoalTask, TaskStep
from mujoban_controller.mpo import MPOCollector, MPOLearner, MPOTrainingConfig, Policy
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.replay import SequenceReplay
from mujoban_core.interfaces import Controller

ConfigT = TypeVar("ConfigT", DistilConfig, MPOTrainingConfig)


class Learner(ABC, Generic[ConfigT]):
    """Collects sequences into a replay and learns from them."""

    def __init__(self, config: ConfigT, rng: np.random.Generator) -> None:
        """Sample batches with `rng`."""
        self.config = config
        self.rng = rng
        self.replay = SequenceReplay(config.replay, config.length)
        self.frames = 0
        """Environment steps so far."""
        self._debt = 0.0

    @property
    @abstractmethod
    def modules(self) -> dict[str, nn.Module]:
        """Everything with weights, for checkpoints."""

    @property
    @abstractmethod
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers by name, for checkpoints."""

    @property
    @abstractmethod
    def product(self) -> VisuomotorController | PrivilegedPolicy:
        """The network that the stage is for."""

    @property
    @abstractmethod
    def driver(self) -> Driver | Controller:
        """The product as a driver, to be judged."""

    @property
    @abstractmethod
    def updates(self) -> int:
        """Gradient steps so far."""

    @updates.setter
    @abstractmethod
    def updates(self, count: int) -> None: ...

    @abstractmethod
    def _play(self) -> tuple[Mapping[str, NDArray], Mapping[str, NDArray], list[TaskStep]]:
        """Play T ticks."""

    @abstractmethod
    def _update(self) -> dict[str, Tensor]:
        """Take one gradient step."""

    def collect(self) -> list[TaskStep]:
        """Add one sequence per robot to the replay; return what happened."""
        ticks, starts, steps = self._play()
        if not self.frames:
            self._prepare(ticks)
        self.replay.add(ticks, starts)
        count = ticks["first"].size
        self.frames += count
        self._debt += count * self.config.reuse
        return steps

    def learn(self) -> dict[str, float]:
        """Make the updates that are due; return their mean statistics."""
        per_update = self.config.length * self.config.sequences
        due = int(self._debt // per_update)
        self._debt -= due * per_update
        history = [self._update() for _ in range(due)]
        names = {name for stats in history for name in stats}
        return {n: float(np.mean([float(s[n]) for s in history if n in s])) for n in sorted(names)}

    def _prepare(self, ticks: Mapping[str, NDArray]) -> None:
        """Look at the first data of a run."""


class DistilLearner(Learner[DistilConfig]):
    """Distillation of a teacher into the camera policy."""

    def __init__(
        self, student: VisuomotorController, task: GoalTask, teacher: Driver, config: DistilConfig,
        rng: np.random.Generator, *, steps: int, fresh: bool,
    ) -> None:  # fmt: skip
        """Distil `teacher`; `steps` fixes the schedule, `fresh` weights have no normalisation yet."""
        super().__init__(config, rng)
        self._fresh = fresh
        total = round(steps * config.reuse / (config.length * config.sequences))
        self._distiller = Distiller(student, config, total)
        self._collector = Collector(task, student, teacher, config, rng)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Student, its moving average, the auxiliary head."""
        d = self._distiller
        return {"student": d.student, "average": d.average, "head": d.head}

    @property
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """One for all."""
        return {"adam": self._distiller.optimiser}

    @property
    def product(self) -> VisuomotorController:
        """The moving average of the student's weights."""
        return self._distiller.average

    @property
    def driver(self) -> Controller:
        """The product."""
        return self.product

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return self._distiller.updates

    @updates.setter
    def updates(self, count: int) -> None:
        self._distiller.updates = count

    def _prepare(self, ticks: Mapping[str, NDArray]) -> None:
        if self._fresh:
            self._distiller.student.fit_normalisation(torch.from_numpy(ticks["proprio"]).flatten(0, 1))

    def _play(self) -> tuple[dict[str, Any], dict[str, Any], list[TaskStep]]:
        self._collector.frames = self.frames
        return self._collector.collect()

    def _update(self) -> dict[str, Tensor]:
        return self._distiller.update(self.replay, self.rng)


class ReinforcementLearner(Learner[MPOTrainingConfig]):
    """MPO of a privileged teacher or of the camera policy."""

    def __init__(
        self, policy: Policy, task: GoalTask, config: MPOTrainingConfig, rng: np.random.Generator, *, fresh: bool,
        recorded: BagSequences | None = None, recorded_share: float = 0.25,
    ) -> None:  # fmt: skip
        """Train `policy`.

        Args:
            policy: Trained in place.
            task: Where it acts.
            config: Settings.
            rng: Source of all randomness.
            fresh: Whether the weights of a camera policy have no normalisation yet.
            recorded: Sequences from bags that join the replay.
            recorded_share: Their share of what joins it.
        """
        super().__init__(config, rng)
        self._fresh = fresh
        self._recorded = recorded
        batch = task.config.batch
        self._recorded_count = max(1, round(batch * recorded_share / (1.0 - recorded_share)))
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        self._mpo = MPOLearner(policy, task.config.body, config, generator)
        self._collector = MPOCollector(task, policy, config.length, generator)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Online and target networks and the dual variables."""
        m = self._mpo
        return {
            "policy": m.policy, "critic": m.critic, "duals": m.loss,
            "target_policy": m.target_policy, "target_critic": m.target_critic,
        }  # fmt: skip

    @property
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Those of policy, critic and dual variables."""
        m = self._mpo
        return {"policy": m.policy_optimiser, "critic": m.critic_optimiser, "duals": m.dual_optimiser}

    @property
    def product(self) -> VisuomotorController | PrivilegedPolicy:
        """The online policy."""
        return self._mpo.policy

    @property
    def driver(self) -> Driver | Controller:
        """The online policy's mean."""
        policy = self._mpo.policy
        return PrivilegedDriver(policy) if isinstance(policy, PrivilegedPolicy) else policy

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return self._mpo.updates

    @updates.setter
    def updates(self, count: int) -> None:
        self._mpo.updates = count

    def collect(self) -> list[TaskStep]:
        """Add one sequence per robot, and what there is from bags, to the replay; return what happened."""
        steps = super().collect()
        if self._recorded is not None:
            for _ in range(self._recorded_count):
                self.replay.add(*next(self._recorded))
            self._debt += self._recorded_count * self.config.length * self.config.reuse
        return steps

    def _prepare(self, ticks: Mapping[str, NDArray]) -> None:
        policy = self._mpo.policy
        if self._fresh and isinstance(policy, VisuomotorController):
            policy.fit_normalisation(torch.from_numpy(ticks["proprio"]).flatten(0, 1))

    def _play(self) -> tuple[dict[str, Any], dict[str, Any], list[TaskStep]]:
        return self._collector.collect()

    def _update(self) -> dict[str, Tensor]:
        return self._mpo.update(self.replay, self.rng)
