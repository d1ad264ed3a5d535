"""MPO over pushes, on the engine: the paper's method (C.2) with options for moves.

n-step returns off-policy from a replay train the critic, discrete MPO the push head.

Shapes: B batch, n steps of a return, E levels, A = 256 pushes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.ranges import check_counts, check_positive, check_shares
from mujoban_planner.boards import BitBoards, signed
from mujoban_planner.growth import open_run
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.product import PlannerLearner
from mujoban_planner.push_actor import BOARDS, STEP, PlayConfig, PushActor
from mujoban_planner.push_policy import PushPolicy, images
from mujoban_planner.push_run import PushRunConfig, starting_anchor, starting_policy, training_record
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_rl.actors import ActorOptions, ActorSource, Experience, ReplayStore
from mujoban_rl.engine import Cadence, Scalars, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_discrete import DiscreteMPO, DiscreteMPOConfig, expected_value
from mujoban_rl.losses.returns import windowed_returns
from mujoban_rl.optimise import ProgressSchedule, guarded_step, moving_average, warm_up_cosine
from mujoban_rl.precision import autocast
from mujoban_rl.replay import SequenceBuilder, SequenceReplay

_KEPT: Final = (*BOARDS, *STEP)
"""What is kept of a step."""
Window = dict[str, Tensor]
"""Successive steps from the replay, [B, n + 1] each."""


@dataclass(frozen=True)
class PushMPOConfig(PushRunConfig):
    """What defines a run of MPO over pushes."""

    play: PlayConfig = field(default_factory=lambda: PlayConfig(environments=128))
    mpo: DiscreteMPOConfig = field(
        default_factory=lambda: DiscreteMPOConfig(epsilon_policy=0.01, initial_temperature=0.3, initial_alpha=1.0)
    )
    batch_size: int = 128
    reuse: float = 1.0
    """Samples that are learned from per push that is played."""
    replay_steps: int = 400
    """Pushes in each level that are kept."""
    first_steps: int = 5120
    """Pushes before the first update."""
    n_step: int = 20
    """Pushes of a return: by then most levels are decided, and little is left to what the critic guesses."""
    discount: float = 0.97
    """Per push."""
    time_outs_lost: bool = True
    """A level that time cuts short counts as lost, though how many moves are left is not seen; it is left out with
    --no-time-outs-lost."""
    q_weight: float = 5.0
    """Weight of the critic's loss."""
    average: float = 0.99
    """Share of the target network that an update leaves; it is what is shipped."""
    learning_rate: float = 1e-3
    """Learning rate."""
    dual_learning_rate: float = 1e-2
    """Learning rate of temperatures and multipliers."""
    warm_up: float = 0.01
    """Share of the budget in which the learning rate rises."""
    last_rate: float = 0.1
    """Share of the learning rate that is left at the end. With less than a twentieth the policy no longer keeps up with
    the bound of its KL, whose dual variable falls to 0, and then runs after the critic's errors."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned, and what is no share."""
        super().__post_init__()
        check_counts(self, "batch_size", "replay_steps", "first_steps", "n_step")
        check_positive(self, "reuse", "q_weight", "learning_rate", "dual_learning_rate")
        check_shares(self, "discount", "average", "warm_up", "last_rate")


class PushMPOLearner(PlannerLearner[Window]):
    """Learns from windows of the replay, each under a random symmetry; what solved most held-out levels is exported."""

    def __init__(self, config: PushMPOConfig) -> None:
        """Build a policy, or start from a planner's weights."""
        super().__init__()
        self.config = config
        self.policy = starting_policy(config)
        self._anchor = starting_anchor(config, self.policy)
        self._average = moving_average(self.policy, config.average, warm_up=True)
        self.mpo = DiscreteMPO(config.mpo)
        self._adam = torch.optim.Adam(self.policy.parameters(), config.learning_rate, eps=1e-5, fused=True)
        self._dual_adam = self.mpo.duals.adam(config.dual_learning_rate)
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(config.warm_up, config.last_rate))
        self._rng = np.random.default_rng([config.seed, 8])

    @property
    def target(self) -> PushPolicy:
        """The averaged policy with its critic."""
        return self._average.module

    @property
    def product(self) -> LearnedPlanner:
        """The averaged planner."""
        return self.target.planner

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Policy, target and dual variables."""
        return {"policy": self.policy, "target": self._average, "mpo": self.mpo}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of the networks and of the dual variables."""
        return {"adam": self._adam, "duals": self._dual_adam}

    def own_state(self) -> State:
        """Return the random state."""
        return State({"rng": self._rng.bit_generator.state})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._rng.bit_generator.state = state.values["rng"]

    def update(self, batch: Window, progress: float, guard: NaNGuard) -> Scalars:
        """Take a step of policy, critic and dual variables."""
        config = self.config
        self._schedule.follow(progress)
        reward, terminated, truncated = (batch[name][:, :-1] for name in ("reward", "terminated", "truncated"))
        if config.time_outs_lost:
            terminated, truncated = terminated | truncated, torch.zeros_like(truncated)
        returns = windowed_returns(reward, terminated, truncated, config.discount)
        rows = torch.arange(len(reward))
        symmetry = self._rng.integers(0, SYMMETRIES, len(rows))
        first, last = (_boards(batch, rows, at) for at in (torch.zeros_like(rows), returns.index))
        with torch.no_grad(), autocast("cpu"):
            before, after = self.target(first, symmetry), self.target(last, symmetry)
        goal = returns.reward + returns.bootstrap * expected_value(after.q, after.logits)
        with autocast("cpu"):
            output = self.policy(first, symmetry)
        policy_loss, stats = self.mpo(output.logits, before.logits, before.q)
        taken = output.q.gather(1, images(batch["push"][:, 0].numpy(), symmetry)[:, None])[:, 0]
        q_loss = (functional.smooth_l1_loss(taken, goal, reduction="none") * returns.valid).mean()
        parts = {"q_loss": q_loss, "stray": output.stray.mean()}
        loss = policy_loss + config.q_weight * q_loss + parts["stray"]
        if self._anchor is not None:
            with autocast("cpu"):
                parts["anchor"] = self._anchor.loss(self.policy.planner, first, symmetry)
            loss = loss + parts["anchor"]
        if guarded_step(loss, [self._adam, self._dual_adam], guard, clip=5.0) is not None:
            self._average.update_parameters(self.policy)
        parts["mean_return"] = goal.mean()
        return scalars(stats._asdict()) | {name: float(value.detach()) for name, value in parts.items()}

    def weights(self) -> Mapping[str, Tensor]:
        """Return the policy's weights."""
        return self.policy.state_dict()


def _boards(batch: Window, rows: Tensor, at: Tensor) -> BitBoards:
    """Return the states at places `at`, [B], of windows."""
    wall, target, box, agent = (batch[name][rows, at].numpy() for name in BOARDS)
    return BitBoards(wall.view(np.uint64), target.view(np.uint64), box.view(np.uint64), agent)


class PushReplay(ReplayStore[Window]):
    """The newest pushes of all actors."""

    def __init__(self, config: PushMPOConfig, actors: int) -> None:
        """Make room for the levels of so many actors."""
        self.config = config
        play, self._length = config.play, config.play.steps + config.n_step
        capacity = max(1, actors * config.replay_steps * play.environments // play.steps)
        super().__init__(SequenceReplay(capacity, self._length), torch.Generator().manual_seed(config.seed))
        self._builders = [self._builder() for _ in range(actors)]
        self._after: list[dict[str, NDArray[Any]]] = [{} for _ in range(actors)]
        """States after the last push of each actor."""

    def _builder(self) -> SequenceBuilder:
        return SequenceBuilder(self._length, self.config.n_step)

    def add(self, experience: Experience) -> None:
        """Keep what an actor delivered."""
        actor, arrays = experience.actor, {name: signed(values) for name, values in experience.arrays.items()}
        after = self._after[actor]
        if any(not np.array_equal(after[name], arrays[name][0]) for name in after):
            # An actor in other levels has taken the place of one that died.
            self._builders[actor] = self._builder()
        for step in range(self.config.play.steps):
            sequence = self._builders[actor].add({name: arrays[name][step] for name in _KEPT})
            if sequence is not None:
                self.replay.add(sequence)
        self._after[actor] = {name: arrays[f"last_{name}"].copy() for name in BOARDS}

    def sample(self) -> Window | None:
        """Return windows of n + 1 successive steps, once an actor has played a whole sequence."""
        if not len(self.replay):
            return None
        return self.replay.sample(self.config.batch_size, self.generator, self.config.n_step + 1)

    def parts(self) -> dict[str, State]:
        """Return all pushes, those that wait for their sequence, and the random state."""
        parts = super().parts()
        for i, (builder, after) in enumerate(zip(self._builders, self._after, strict=True)):
            states = State(tensors={name: torch.from_numpy(values) for name, values in after.items()})
            parts[f"actor{i}"] = State.of({"builder": builder.state(), "after": states})
        return parts

    def restore(self, state: State) -> None:
        """Take over what `state` returned, of as many actors or not.

        Raises:
            ValueError: If other things were kept of a step then.
        """
        _check_kept(state.part("replay"))
        super().restore(state)
        for i, builder in enumerate(self._builders):
            if f"actor{i}" in state.values:
                part = state.part(f"actor{i}")
                _check_kept(part.part("builder"))
                builder.restore(part.part("builder"))
                self._after[i] = {name: values.numpy() for name, values in part.part("after").tensors.items()}


def _check_kept(steps: State) -> None:
    """Raise ValueError if steps are held, and other things of them than a learner reads."""
    if steps.tensors and steps.tensors.keys() != set(_KEPT):
        raise ValueError(f"of pushes it holds {', '.join(sorted(steps.tensors))}: expected {', '.join(sorted(_KEPT))}")


def push_mpo(
    config: PushMPOConfig, directory: Path, cadence: Cadence, actors: ActorOptions | None = None
) -> Trainer[Window]:
    """Return the trainer of a run of MPO over pushes, resumed if there is one in the directory."""
    options = actors or ActorOptions()
    source = ActorSource(
        options.pool(partial(PushActor, config.network, config.play, config.seed)),
        PushReplay(config, options.num_actors),
        steps_per_update=config.batch_size / config.reuse,
        first_steps=config.first_steps,
    )
    return Trainer(
        open_run(directory, config),
        PushMPOLearner(config),
        source,
        config.budget,
        cadence,
        record=training_record("mpo over pushes", config),
    )
