"""Proximal policy optimisation over pushes, on the engine.

Shapes: T steps, E levels, M samples of a minibatch, A = 256 pushes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Categorical

from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_planner.boards import BitBoards
from mujoban_planner.growth import open_run
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.product import PlannerLearner
from mujoban_planner.push_actor import BOARDS, STEP, PlayConfig, PushActor
from mujoban_planner.push_run import PushRunConfig, starting_anchor, starting_policy, training_record
from mujoban_rl.actors import ActorOptions, ActorSource, Arrays, Rollouts
from mujoban_rl.engine import Cadence, Scalars, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.ppo import PPOConfig, generalised_advantages, ppo_loss
from mujoban_rl.optimise import ProgressSchedule, guarded_step, warm_up_cosine
from mujoban_rl.precision import autocast

PPO_PACE: Final = {"publish_updates": 1}
"""How often a run publishes: each rollout is to be played by the newest policy."""


@dataclass(frozen=True)
class PushPPOConfig(PushRunConfig):
    """What defines a run of PPO over pushes."""

    play: PlayConfig = field(default_factory=PlayConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    epochs: int = 3
    """Times that each rollout is learned from."""
    minibatch: int = 512
    """States of a step of the optimiser."""
    discount: float = 0.97
    """Per push."""
    decay: float = 0.95
    """lambda of generalised advantages."""
    entropy: float = 0.01
    """Weight of the policy's entropy."""
    learning_rate: float = 1e-3
    """Learning rate."""
    warm_up: float = 0.01
    """Share of the budget in which the learning rate rises."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned, and what is no share."""
        super().__post_init__()
        check_counts(self, "epochs", "minibatch")
        check_not_negative(self, "entropy")
        check_positive(self, "learning_rate")
        check_shares(self, "discount", "decay", "warm_up")


class PushPPOLearner(PlannerLearner[Arrays]):
    """Learns from the rollouts of `PushActor`."""

    def __init__(self, config: PushPPOConfig) -> None:
        """Build a policy, or start from a planner's weights."""
        super().__init__()
        self.config = config
        self.policy = starting_policy(config)
        self._anchor = starting_anchor(config, self.policy)
        self._adam = torch.optim.Adam(self.policy.parameters(), config.learning_rate, eps=1e-5, fused=True)
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(config.warm_up))
        self._rng = np.random.default_rng([config.seed, 7])

    @property
    def product(self) -> LearnedPlanner:
        """The planner."""
        return self.policy.planner

    @property
    def modules(self) -> Mapping[str, torch.nn.Module]:
        """The policy with its critic."""
        return {"policy": self.policy}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Adam."""
        return {"adam": self._adam}

    def own_state(self) -> State:
        """Return the random state."""
        return State({"rng": self._rng.bit_generator.state})

    def restore_own(self, state: State) -> None:
        """Take over the random state."""
        self._rng.bit_generator.state = state.values["rng"]

    def update(self, batch: Arrays, progress: float, guard: NaNGuard) -> Scalars:
        """Learn from a rollout for some epochs."""
        config = self.config
        self._schedule.follow(progress)
        advantage, target = self._advantages(batch)
        boards = BitBoards._make(batch[name].reshape(-1) for name in BOARDS)
        push, old = (torch.from_numpy(batch[name].reshape(-1).copy()) for name in ("push", "log_prob"))
        means: dict[str, list[float]] = {}
        for _ in range(config.epochs):
            order = self._rng.permutation(len(push))
            for rows in np.array_split(order, max(1, len(push) // config.minibatch)):
                states = BitBoards._make(column[rows] for column in boards)
                with autocast("cpu"):
                    output = self.policy(states)
                # What is not finite goes through, for the guard to see.
                policy = Categorical(logits=output.logits, validate_args=False)
                log_prob = policy.log_prob(push[rows])
                loss, stats = ppo_loss(log_prob, old[rows], advantage[rows], output.value, target[rows], config.ppo)
                entropy = policy.entropy().mean()
                parts = {**stats, "entropy": entropy, "stray": output.stray.mean()}
                loss = loss - config.entropy * entropy + parts["stray"]
                if self._anchor is not None:
                    with autocast("cpu"):
                        parts["anchor"] = self._anchor.loss(self.policy.planner, states)
                    loss = loss + parts["anchor"]
                guarded_step(loss, [self._adam], guard, clip=1.0)
                for name, value in parts.items():
                    means.setdefault(name, []).append(float(value.detach()))
        return {f"ppo/{name}": float(np.mean(values)) for name, values in means.items()}

    def _advantages(self, batch: Arrays) -> tuple[Tensor, Tensor]:
        """Return normalised advantages and targets of values, [T * E]."""
        length, levels = batch["reward"].shape
        boards = BitBoards._make(np.concatenate([batch[name], batch[f"last_{name}"][None]]).ravel() for name in BOARDS)
        with torch.no_grad(), autocast("cpu"):
            value = self.policy(boards).value.view(length + 1, levels)
        reward, terminated, truncated = (torch.from_numpy(batch[name].copy()) for name in STEP[1:])
        # How many moves are left is not seen: what time cuts short is worth what was held of it, and teaches nothing.
        reward = torch.where(truncated, value[:-1], reward)
        discount = self.config.discount * (~(terminated | truncated)).float()
        advantage, target = generalised_advantages(reward, discount, value[:-1], value[-1], self.config.decay)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6) * ~truncated
        return advantage.flatten(), target.flatten()

    def weights(self) -> Mapping[str, Tensor]:
        """Return the policy's weights."""
        return self.policy.state_dict()


def push_ppo(
    config: PushPPOConfig, directory: Path, cadence: Cadence, actors: ActorOptions | None = None
) -> Trainer[Arrays]:
    """Return the trainer of a run of PPO over pushes, resumed if there is one in the directory."""
    options = actors or ActorOptions()
    pool = options.pool(partial(PushActor, config.network, config.play, config.seed))
    source = ActorSource(pool, Rollouts(axis=-1, count=options.num_actors))
    return Trainer(
        open_run(directory, config),
        PushPPOLearner(config),
        source,
        config.budget,
        cadence,
        record=training_record("ppo over pushes", config),
    )
