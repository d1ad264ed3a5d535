"""PPO of the privileged teacher in the goal task, for any body.

The mirrored robot should act as the mirrored policy does (`FeatureLayout.mirror`); a loss says so, without which boxes
drift to one side.

Shapes: T ticks of a rollout, B robots, D features, U actuators, M samples of a minibatch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from mujoban_controller.goal_features import Rearrangement, feature_layout
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.judge import OutcomeSummary
from mujoban_controller.privileged import PrivilegedPolicy, Value
from mujoban_controller.product import ProductLearner, Validation
from mujoban_core.bodies import get_body
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_rl.engine import Scalars, Source, State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.ppo import PPOConfig, generalised_advantages, ppo_loss
from mujoban_rl.networks import Gaussian
from mujoban_rl.optimise import guarded_step


@dataclass(frozen=True)
class PPOTrainingConfig:
    """Settings of PPO in the goal task."""

    length: int = 32
    """T, ticks that each robot plays before an update."""
    epochs: int = 4
    """Passes of an update over what was played."""
    minibatch: int = 1024
    """M, samples of a minibatch."""
    gamma: float = 0.98
    """Discount from one tick to the next."""
    decay: float = 0.95
    """lambda of the advantages."""
    rate: float = 5e-4
    """Learning rate at the start."""
    least_rate: float = 3e-5
    """Lowest learning rate."""
    largest_rate: float = 2e-3
    """Highest learning rate."""
    target_kl: float = 0.02
    """The learning rate is adapted so that an update changes the policy by about this much; what it may reach at most
    falls to `least_rate` over the budget."""
    clip: float = 1.0
    """Largest norm of a gradient."""
    bound_weight: float = 0.05
    """Weight of the squared distance by which means lie outside [-1.2, 1.2]."""
    mirror_weight: float = 1.0
    """Weight of the loss of symmetry: the mirrored robot is to do the mirrored thing."""
    normalised: int = 300
    """Updates after which the normalisation of features stays as it is."""
    loss: PPOConfig = field(default_factory=PPOConfig)

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned."""
        check_counts(self, "length", "epochs", "minibatch")
        check_counts(self, "normalised", least=0)
        check_shares(self, "gamma", "decay")
        check_positive(self, "rate", "least_rate", "largest_rate", "target_kl", "clip")
        check_not_negative(self, "bound_weight", "mirror_weight")
        if self.least_rate > self.largest_rate:
            raise ValueError(f"least_rate is {self.least_rate}: expected at most largest_rate, {self.largest_rate}")


class Rollout(NamedTuple):
    """T ticks of B robots under one policy."""

    features: Tensor
    """[T + 1, B, D]."""
    action: Tensor
    """Not limited, [T, B, U]."""
    log_prob: Tensor
    """[T, B]."""
    reward: Tensor
    """[T, B]."""
    discount: Tensor
    """0 where nothing follows, [T, B]."""
    truncated: Tensor
    """Where an episode was cut short, bool [T, B]."""


def log_prob(policy: Gaussian, action: Tensor) -> Tensor:
    """Return log densities, [...], of actions [..., U]."""
    return Independent(Normal(policy.mean, policy.scale, validate_args=False), 1, validate_args=False).log_prob(action)


def mirrored(x: Tensor, mirror: Rearrangement) -> Tensor:
    """Return what the mirrored robot would see or do, [..., N]."""
    source, sign = (torch.from_numpy(a).to(x.device) for a in mirror)
    return x[..., source] * sign


class RolloutSource(Source[Rollout]):
    """Plays the goal task with the newest policy."""

    def __init__(self, task: GoalTask, policy: PrivilegedPolicy, length: int, generator: torch.Generator) -> None:
        """Play rollouts of `length` ticks with a copy of `policy` that `publish` renews."""
        self.task, self._length, self._generator = task, length, generator
        self._policy = PrivilegedPolicy(**policy.config)  # pyright: ignore[reportArgumentType]
        self._summary = OutcomeSummary()

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Act with these weights from now on."""
        self._policy.load_state_dict(dict(weights))

    @torch.no_grad()
    def next_batch(self) -> Rollout:
        """Play T ticks."""
        task, ticks = self.task, []
        features = torch.from_numpy(task.features())
        for _ in range(self._length):
            policy = self._policy(features)
            action = policy.sample(self._generator)
            result = task.step(action.clamp(-1.0, 1.0).numpy())
            self._summary.add(result.outcomes)
            arrays = (torch.from_numpy(a) for a in (result.reward, result.discount, result.truncated))
            ticks.append((features, action, log_prob(policy, action), *arrays))
            features = torch.from_numpy(task.features())
        self.samples += self._length * len(features)
        seen, *rest = (torch.stack(column) for column in zip(*ticks, strict=True))
        return Rollout(torch.cat([seen, features[None]]), *rest)

    def state(self) -> State:
        """Return what changes beside the weights."""
        own = State(tensors={"generator": self._generator.get_state()})
        return State.of({"task": self.task.state(), "noise": own})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.task.restore(state.part("task"))
        self._generator.set_state(state.part("noise").tensors["generator"])

    def statistics(self) -> Scalars:
        """Return how instructions went since the last call."""
        summary, self._summary = self._summary, OutcomeSummary()
        return summary.scalars()


class PPOLearner(ProductLearner[Rollout]):
    """Teacher and value network."""

    def __init__(
        self,
        policy: PrivilegedPolicy,
        body: str,
        config: PPOTrainingConfig,
        generator: torch.Generator,
        validation: Validation | None = None,
    ) -> None:
        """Train `policy` in place, where it is; `generator`, on the CPU, fixes the order of samples."""
        super().__init__(validation or Validation())
        self.policy, self.config = policy, config
        self.value = Value(body).to(policy.device)
        layout = feature_layout(get_body(body))
        self._mirror, self._mirror_action = layout.mirror, layout.mirror_action
        self._turning = layout.holds if get_body(body).turn is None else None
        parameters = [*policy.parameters(), *self.value.parameters()]
        self._adam = torch.optim.Adam(parameters, config.rate, eps=1e-5, fused=True)
        self._generator = generator
        self._rounds = 0

    @property
    def product(self) -> PrivilegedPolicy:
        """The policy."""
        return self.policy

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Policy and value network."""
        return {"policy": self.policy, "value": self.value}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """One for both."""
        return {"adam": self._adam}

    def own_state(self) -> State:
        """Return the order of samples and how often it was drawn."""
        return State({"rounds": self._rounds}, {"generator": self._generator.get_state()})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._rounds = state.values["rounds"]
        self._generator.set_state(state.tensors["generator"])

    def weights(self) -> Mapping[str, Tensor]:
        """Return the policy's."""
        return {k: v.clone() for k, v in self.policy.state_dict().items()}

    def update(self, batch: Rollout, progress: float, guard: NaNGuard) -> Scalars:
        """Learn from a rollout for some epochs; adapt the learning rate to how much that changed the policy."""
        config, batch = self.config, Rollout(*(x.to(self.policy.device) for x in batch))
        samples = self._samples(batch)
        count, last, stats = len(samples[0]), [], {}
        for epoch in range(config.epochs):
            order = torch.randperm(count, generator=self._generator).to(self.policy.device)
            for chosen in order.split(config.minibatch):
                loss, stats = self._loss(*(x[chosen] for x in samples))
                if guarded_step(loss, [self._adam], guard, clip=config.clip) is not None and epoch == config.epochs - 1:
                    last.append(float(stats["kl"]))
        if last:
            self._adapt(float(np.mean(last)), progress)
            if self._rounds < config.normalised:
                for module in (self.policy, self.value):
                    module.normaliser.update(batch.features[:-1].flatten(0, 1))
            self._rounds += 1
        scalars = {k: float(v) for k, v in stats.items()}
        return {**scalars, "reward": float(batch.reward.mean()), "rate": self._adam.param_groups[0]["lr"]}

    @torch.no_grad()
    def _samples(self, batch: Rollout) -> tuple[Tensor, ...]:
        """Return features, actions, log densities, advantages and value targets of all ticks, [T * B, ...]."""
        gamma = self.config.gamma
        value = self.value(batch.features)
        # The value of the state in which an episode was cut short is about that of the state before.
        reward = batch.reward + gamma * value[:-1] * batch.truncated
        advantage, target = generalised_advantages(
            reward, gamma * batch.discount, value[:-1], value[-1], self.config.decay
        )
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        columns = (batch.features[:-1], batch.action, batch.log_prob, advantage, target)
        return tuple(x.flatten(0, 1) for x in columns)

    def _loss(
        self, features: Tensor, action: Tensor, old: Tensor, advantage: Tensor, target: Tensor
    ) -> tuple[Tensor, dict[str, Any]]:
        config = self.config
        policy = self.policy(features)
        loss, stats = ppo_loss(
            log_prob(policy, action), old, advantage, self.value(features), target, config.loss
        )
        bound = (policy.mean.abs() - 1.2).clamp(min=0.0).square().sum(-1).mean()
        loss = loss + config.bound_weight * bound
        if config.mirror_weight > 0.0:
            other = mirrored(self.policy(mirrored(features, self._mirror)).mean, self._mirror_action)
            error = (policy.mean - other).square().mean(-1)
            if self._turning is not None:
                # A look around has a side to which it turns.
                error = error * (1.0 - features[..., self._turning])
            asymmetry = error.mean()
            loss = loss + config.mirror_weight * asymmetry
            stats["asymmetry"] = asymmetry.detach()
        return loss, {**stats, "scale": policy.scale.detach().mean()}

    def _adapt(self, kl: float, progress: float) -> None:
        config = self.config
        factor = 1 / 1.5 if kl > 2.0 * config.target_kl else 1.5 if kl < config.target_kl / 2.0 else 1.0
        largest = config.least_rate + (config.largest_rate - config.least_rate) * (1.0 - progress)
        for group in self._adam.param_groups:
            group["lr"] = min(max(group["lr"] * factor, config.least_rate), largest)
