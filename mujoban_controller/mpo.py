"""MPO in the goal task: a privileged policy, or the camera policy with an asymmetric critic (paper C.3).

Both run on sequences from a replay. The camera policy's recurrent state at the start of a sequence is the one
that it had when the sequence was played.

Shapes: B robots, T ticks, M sequences in a batch, N sampled actions, U actuators, D privileged features.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.controller import Gaussian, Recurrent, VisuomotorController
from mujoban_controller.goal_features import privileged_features
from mujoban_controller.goal_task import GoalTask, TaskStep
from mujoban_controller.privileged import Critic, PrivilegedPolicy
from mujoban_controller.replay import SequenceReplay, memory_fields
from mujoban_core.interfaces import Memory, renew_rows
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_continuous import MPOConfig, MPOLoss
from mujoban_rl.losses.returns import td_target

Policy = PrivilegedPolicy | VisuomotorController


@dataclass(frozen=True)
class MPOTrainingConfig:
    """Settings of MPO in the goal task; those of Acme (Hoffman et al. 2020)."""

    length: int = 16
    """T, ticks of a sequence."""
    sequences: int = 24
    """M, sequences of a batch."""
    replay: int = 40_000
    """Sequences in the replay."""
    reuse: float = 4.0
    """Times that each frame is trained on, on average."""
    n_step: int = 5
    samples: int = 20
    """N."""
    gamma: float = 0.99
    target_period: int = 100
    """Updates between copies to the target networks."""
    policy_rate: float = 3e-4
    critic_rate: float = 3e-4
    clip: float = 40.0
    critic_first: int = 0
    """Updates in which the critic learns alone; a policy that is good already needs it."""
    loss: MPOConfig = field(default_factory=MPOConfig)

    def __post_init__(self) -> None:
        """Reject sequences that hold no n-step return."""
        if self.length <= self.n_step:
            raise ValueError(f"length {self.length}: expected more ticks than n_step {self.n_step}")


def policy_over(policy: Policy, batch: Mapping[str, Tensor]) -> Gaussian:
    """Return the policy's distributions along sequences, [M, T, U]."""
    if isinstance(policy, PrivilegedPolicy):
        return policy(batch["state"])
    memory = Recurrent(*(batch[f"memory{i}"] for i in range(3)))
    inputs = (batch[k] for k in ("frame", "proprio", "instruction", "terminated"))
    return policy(*inputs, memory, batch["first"]).action


class MPOCollector:
    """Lets the policy act with exploration in the goal task."""

    def __init__(self, task: GoalTask, policy: Policy, length: int, generator: torch.Generator) -> None:
        """Collect sequences of `length` ticks."""
        self.task, self.policy, self.length, self._generator = task, policy, length, generator
        self._memory: Memory = ()
        if isinstance(policy, VisuomotorController):
            self._memory = policy.initial_memory(task.world.batch)

    def collect(self) -> tuple[dict[str, NDArray], dict[str, NDArray], list[TaskStep]]:
        """Play T ticks; return per-tick fields [T, B, ...], the memory at the start, and what happened."""
        starts = memory_fields(self._memory)
        ticks, steps = [], []
        for _ in range(self.length):
            tick, outcome = self._tick()
            ticks.append(tick)
            steps.append(outcome)
        return {k: np.stack([t[k] for t in ticks]) for k in ticks[0]}, starts, steps

    @torch.inference_mode()
    def _tick(self) -> tuple[dict[str, Any], TaskStep]:
        task, first = self.task, self.task.first.copy()
        tick: dict[str, Any] = {"state": privileged_features(task.world, task.elapsed), "first": first}
        if isinstance(self.policy, VisuomotorController):
            fresh = self.policy.initial_memory(len(first))
            inputs = task.observe()
            memory = renew_rows(self._memory, fresh, first)
            output = self.policy(*self.policy.to_tensors(inputs), memory=Recurrent(*memory))
            self._memory = output.memory
            action = Gaussian(output.action.mean[:, 0], output.action.scale[:, 0])
            fields = ("frame", "proprio", "instruction", "terminated")
            tick |= {name: getattr(inputs, name) for name in fields}
        else:
            action = self.policy(torch.from_numpy(tick["state"]))
        torque = action.sample(self._generator).clamp(-1.0, 1.0).numpy()
        result = task.step(torque)
        return {**tick, "action": torque, "reward": result.reward, "discount": result.discount}, result


class MPOLearner:
    """Online and target networks, dual variables and optimisers; one `update` per batch."""

    def __init__(self, policy: Policy, body: str, config: MPOTrainingConfig, generator: torch.Generator) -> None:
        """Train `policy` in place."""
        self.policy, self.config, self._generator = policy, config, generator
        self.critic = Critic(body)
        self.loss = MPOLoss(policy.action_size, config.loss)
        self.target_policy, self.target_critic = deepcopy(policy), deepcopy(self.critic)
        self.policy_optimiser = torch.optim.Adam(policy.parameters(), config.policy_rate)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), config.critic_rate)
        self.dual_optimiser = self.loss.duals.adam(config.loss.dual_learning_rate)
        self.updates = 0

    def update(self, replay: SequenceReplay, rng: np.random.Generator) -> dict[str, Tensor]:
        """Take one gradient step of critic and policy; return statistics."""
        config = self.config
        batch = replay.sample(config.sequences, rng, next(self.policy.parameters()).device)
        with torch.no_grad():
            target = policy_over(self.target_policy, batch)
            noise = torch.randn(
                (config.samples, *target.mean.shape), generator=self._generator, device=target.mean.device
            )
            # Shapes [N, M, T, U] and [N, M, T].
            action = target.mean + target.scale * noise
            q = self.target_critic(batch["state"], action)
        stats = {"loss/critic": self._update_critic(batch, q.mean(0))}
        if self.updates >= config.critic_first:
            stats |= self._update_policy(batch, target, action, q)
        self.updates += 1
        if self.updates % config.target_period == 0:
            self.target_policy.load_state_dict(self.policy.state_dict())
            self.target_critic.load_state_dict(self.critic.state_dict())
        return stats

    def _update_critic(self, batch: Mapping[str, Tensor], value: Tensor) -> Tensor:
        n, length = self.config.n_step, self.config.length
        starts = length - n
        # Shape [M, T - n, n].
        reward, discount = (batch[k].unfold(1, n, 1)[:, :starts].flatten(0, 1) for k in ("reward", "discount"))
        target = td_target(reward, discount, value[:, n:].flatten(), self.config.gamma)
        predicted = self.critic(batch["state"][:, :starts], batch["action"][:, :starts]).flatten()
        loss = functional.mse_loss(predicted, target)
        self.critic_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._step(self.critic, self.critic_optimiser)
        return loss.detach()

    def _update_policy(
        self, batch: Mapping[str, Tensor], target: Gaussian, action: Tensor, q: Tensor
    ) -> dict[str, Tensor]:
        online = policy_over(self.policy, batch)
        loss, stats = self.loss(
            (online.mean.flatten(0, 1), online.scale.flatten(0, 1)),
            (target.mean.flatten(0, 1), target.scale.flatten(0, 1)),
            action.flatten(1, 2),
            q.flatten(1),
        )
        self.policy_optimiser.zero_grad(set_to_none=True)
        self.dual_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = self._step(self.policy, self.policy_optimiser)
        self.dual_optimiser.step()
        named = {name: torch.tensor(value) for name, value in scalars(stats._asdict()).items()}
        return {**named, "gradient_norm": norm}

    def _step(self, module: nn.Module, optimiser: torch.optim.Optimizer) -> Tensor:
        """Apply the gradients unless they are not finite; return their norm."""
        norm = nn.utils.clip_grad_norm_(module.parameters(), self.config.clip)
        if bool(torch.isfinite(norm)):
            optimiser.step()
        return norm
