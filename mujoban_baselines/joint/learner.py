"""Planner and controller learn side by side, each by its own MPO, from what they have played together.

Shapes: M windows, W ticks of a window, D decisions of a batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

import mujoban_planner
from mujoban_baselines.joint.actor import DECISION, SEEN, Networks, make_actor
from mujoban_baselines.joint.decisions import FIELDS
from mujoban_baselines.joint.settings import JointSettings, StartingWeights
from mujoban_baselines.task import TaskConfig
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.mpo import MPOLearner
from mujoban_controller.privileged import Critic
from mujoban_planner.discrete_mpo import MPOBatch
from mujoban_planner.move_learner import MoveLearner
from mujoban_rl.actors import ActorOptions, ActorSource, Experience, ReplayStore, learner_generators
from mujoban_rl.engine import Learner, Scalars, State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.replay import SequenceReplay, steps_per_update
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import load_weights, save_weights

_CRITIC_WIDTH = 256


class JointBatch(NamedTuple):
    """What an update learns from."""

    ticks: dict[str, Tensor]
    """Windows, [M, W, ...]; see `JointActor`."""
    decisions: MPOBatch | None
    """[D]; None as long as none has been finished."""


class JointStore(ReplayStore[JointBatch]):
    """The last ticks, and the last decisions."""

    def __init__(self, settings: JointSettings, generator: torch.Generator) -> None:
        """Start empty; `generator` draws."""
        own = settings.controller
        new = own.sequence - own.skipped
        super().__init__(SequenceReplay(max(own.replay // new, own.windows), own.sequence), generator)
        self._decisions = SequenceReplay(settings.planner.replay, 1)
        self._windows, self._batch = own.windows, settings.planner.batch

    def add(self, experience: Experience) -> None:
        """Take in what an actor delivered."""
        arrays = experience.arrays
        self.replay.add({name: values for name, values in arrays.items() if not name.startswith(DECISION)})
        self._decisions.add({name: arrays[f"{DECISION}{name}"][None] for name in FIELDS})

    def sample(self) -> JointBatch:
        """Return windows and decisions, drawn evenly."""
        ticks = self.replay.sample(self._windows, self.generator)
        if not self._decisions.added:
            return JointBatch(ticks, None)
        found = self._decisions.sample(self._batch, self.generator)
        fields = [found[name][:, 0] for name in FIELDS]
        return JointBatch(ticks, MPOBatch(*fields, valid=torch.ones(self._batch, dtype=torch.bool)))

    def parts(self) -> dict[str, State]:
        """Return all that changes, by name."""
        return super().parts() | {"decisions": self._decisions.state()}

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        super().restore(state)
        self._decisions.restore(state.part("decisions"))


class JointLearner(Learner[JointBatch]):
    """The learners of the two modules."""

    def __init__(self, networks: Networks, settings: JointSettings, generator: torch.Generator) -> None:
        """Train `networks` in place; `generator` draws the torques of the E-step."""
        self.networks, body = networks, networks.controller.body
        networks.controller.mixed_precision = True
        critic = Critic(body, _CRITIC_WIDTH, extra=SEEN)
        self.controller = MPOLearner(
            networks.controller.train(), body, settings.controller, generator, critic=critic
        )
        own = settings.planner
        self.planner = MoveLearner(
            own.mpo, networks.planner, teach_pushes=True, anchor=own.anchor, critic_first=own.critic_first
        )

    @property
    def _parts(self) -> dict[str, Learner[Any]]:
        return {"controller": self.controller, "planner": self.planner}

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Those of both learners."""
        return {f"{name}_{k}": v for name, part in self._parts.items() for k, v in part.modules.items()}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of both learners."""
        return {f"{name}_{k}": v for name, part in self._parts.items() for k, v in part.optimisers.items()}

    def state(self) -> State:
        """Return the state of both learners."""
        return State.of({name: part.state() for name, part in self._parts.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        for name, part in self._parts.items():
            part.restore(state.part(name))

    def update(self, batch: JointBatch, progress: float, guard: NaNGuard) -> Scalars:
        """Take one step of each."""
        stats = {f"controller/{k}": v for k, v in self.controller.update(batch.ticks, progress, guard).items()}
        if batch.decisions is not None:
            stats |= {f"planner/{k}": v for k, v in self.planner.update(batch.decisions, progress, guard).items()}
        return stats

    def weights(self) -> Mapping[str, Tensor]:
        """Return those of the policies that act."""
        controller = {f"controller.{name}": value for name, value in self.controller.weights().items()}
        return self.networks.weights() | controller

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write `controller.safetensors` and `planner.safetensors` with their records."""
        self.controller.export(directory, record)
        target = self.planner.target
        save_weights(directory.path / "planner.safetensors", target, target.config, record)


def joint_parts(
    task: TaskConfig, start: StartingWeights, settings: JointSettings, seed: int, actors: ActorOptions
) -> tuple[JointLearner, ActorSource[JointBatch]]:
    """Return learner and source of a joint fine-tuning.

    Raises:
        ValueError: If weights are missing, damaged, or of another body.
    """
    torch.manual_seed(seed)  # the critic's initial weights
    networks = Networks(
        load_weights(VisuomotorController, start.path("controller", task.body), body=task.body),
        mujoban_planner.load(start.path("planner", task.body), compiled=False),
    )
    generators = learner_generators(seed, 2)
    factory = partial(make_actor, task, networks.plans(), start, settings, seed)
    own = settings.controller
    source = ActorSource(
        actors.pool(factory), JointStore(settings, generators[0]),
        steps_per_update=steps_per_update(own.windows, own.window - own.skipped, own.reuse), first_steps=own.first,
    )  # fmt: skip
    return JointLearner(networks, settings, generators[1]), source
