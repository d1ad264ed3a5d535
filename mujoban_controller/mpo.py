"""MPO in the goal task: a privileged teacher, or the camera policy with an asymmetric critic (paper C.3).

Both learn from windows of a replay. The camera policy's memory at the start of a window is the one that it had when
the window was played. The critic sees the privileged features.

Shapes: M windows of a batch, W ticks of a window, n steps of a return, N sampled actions, U actuators, D features.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.play import CRITIC, Batch, CriticDraw, put_on
from mujoban_controller.policy import GoalPolicy
from mujoban_controller.privileged import Critic
from mujoban_controller.product import ProductLearner, Validation
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_rl.engine import Scalars, State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_continuous import MPOConfig, MPOLoss, check_samples, paired_noise
from mujoban_rl.losses.returns import td_target
from mujoban_rl.networks import Gaussian
from mujoban_rl.optimise import guarded_step, moving_average
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import save_weights


@dataclass(frozen=True)
class MPOTrainingConfig:
    """Settings of MPO in the goal task; where not said otherwise those of Acme."""

    window: int = 6
    """W, ticks of a window; the policy learns in the ticks from n on, the critic in as many from the first on."""
    windows: int = 256
    """M, windows of a batch."""
    sequence: int = 32
    """Ticks of a sequence in the replay, at least W."""
    replay: int = 500_000
    """Environment steps in the replay."""
    first: int = 10_000
    """Environment steps before the first update."""
    reuse: float = 4.0
    """Times that each step is learned from, on average."""
    n_step: int = 5
    """n of the n-step returns: rewards before they bootstrap from the critic."""
    samples: int = 20
    """N, actions drawn in each state for the E-step; an even number."""
    gamma: float = 0.98
    """Discount from one tick to the next."""
    target_period: int = 100
    """Updates between copies to the target networks, of each its own."""
    policy_rate: float = 3e-4
    """Learning rate of the policy."""
    critic_rate: float = 3e-4
    """Learning rate of the critic."""
    clip: float = 40.0
    """Largest norm of the gradient."""
    critic_first: int = 0
    """Updates in which the critic learns alone, of what was played; a policy that is good already needs it."""
    explore: float = 0.0
    """Least standard deviation of the torques of every third robot: without it a policy that is sure of itself shows
    the critic nothing else."""
    steady: float = 0.0
    """Share of robots that play by the mean torques, as the product does. A robot that is held up by a peg is freed by
    noise, by steady torques it may never be: such places are learned from where they are played."""
    average: float = 0.0
    """Decay of a moving average of the policy, which then acts, is the reference of the trust region, and is what the
    run makes; 0: the policy itself. Updates from few windows at a constant rate leave noise in a large network."""
    normalised: int = 2_000
    """Updates after which the normalisation of features stays as it is."""
    loss: MPOConfig = field(default_factory=MPOConfig)

    @property
    def skipped(self) -> int:
        """Ticks of a window in which nothing is learned."""
        return self.n_step

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned, and windows that hold no n-step return or no sequence holds."""
        check_counts(self, "windows", "replay", "n_step", "target_period")
        check_counts(self, "first", "critic_first", "normalised", least=0)
        check_shares(self, "gamma", "average", "steady")
        check_positive(self, "gamma", "reuse", "policy_rate", "critic_rate", "clip")
        check_not_negative(self, "explore")
        if self.sequence < self.window:
            raise ValueError(f"sequence is {self.sequence}: expected at least the ticks of a window, {self.window}")
        check_samples(self.samples)
        if self.window <= self.n_step:
            raise ValueError(f"window is {self.window}: expected more ticks than n_step {self.n_step}")


@dataclass(frozen=True)
class AsymmetricConfig(MPOTrainingConfig):
    """Settings of MPO of a camera policy, whose critic sees more than it does and no frames."""

    critic_updates: int = 0
    """Updates of the critic for each of the policy, from a replay of its own; what comes after its n steps is then
    valued by the distributions that played. 0: one, from the policy's windows."""
    critic_windows: int = 256
    """Windows of n + 1 ticks of such an update."""
    critic_replay: int = 300_000
    """Environment steps in its replay."""
    initial_scale: float = 0.0
    """Standard deviation of the torques at the start; 0: the policy's own. That of a distilled one is a tenth: within
    it values hardly differ, and the critic's errors do."""
    loss: MPOConfig = field(default_factory=lambda: MPOConfig(initial_temperature=0.3))
    """From Acme's 10 the temperature takes a third of such a run to come down to where values count."""

    def __post_init__(self) -> None:
        """Reject numbers with which the critic learns nothing as well."""
        super().__post_init__()
        check_counts(self, "critic_updates", least=0)
        check_counts(self, "critic_windows", "critic_replay")
        check_not_negative(self, "initial_scale")

    @property
    def critic_draw(self) -> CriticDraw | None:
        """What is drawn for the critic alone."""
        if not self.critic_updates:
            return None
        capacity = max(self.critic_replay // self.sequence, 1)
        return CriticDraw(capacity, self.n_step + 1, self.critic_updates, self.critic_windows)


class _Draws(NamedTuple):
    """What the E-step weighs."""

    target: Gaussian
    """[M, W - n, U]."""
    action: Tensor
    """[N, M, W - n, U]."""
    q: Tensor
    """[N, M, W - n]."""


def _beside(batch: Batch) -> Batch:
    """Return what a batch holds for the critic alone."""
    return {name.removeprefix(CRITIC): values for name, values in batch.items() if name.startswith(CRITIC)}


class MPOLearner(ProductLearner[Batch]):
    """Online and target networks, and dual variables.

    Where a batch says in which ticks the policy has `driven`, bool [M, W], it is improved in these alone.
    """

    def __init__(
        self,
        policy: GoalPolicy,
        body: str,
        config: MPOTrainingConfig,
        generator: torch.Generator,
        validation: Validation | None = None,
        critic: Critic | None = None,
    ) -> None:
        """Train `policy` in place, where it is.

        Args:
            policy: What is to be improved.
            body: Of the robot.
            config: Settings.
            generator: Draws the actions of the E-step, on the CPU.
            validation: On what the policy is judged.
            critic: Its critic, if it is not to begin untaught, or sees more than the privileged features of the goal
                task.
        """
        super().__init__(validation or Validation())
        self.policy, self.config, self._generator = policy, config, generator
        self.critic = (critic or Critic(body)).to(policy.device)
        self.loss = MPOLoss(policy.action_size, config.loss).to(policy.device)
        self.target_policy, self.target_critic = deepcopy(policy), deepcopy(self.critic)
        self._average = moving_average(policy, config.average) if config.average else None
        self._policy_adam = torch.optim.Adam(policy.parameters(), config.policy_rate, fused=True)
        self._critic_adam = torch.optim.Adam(self.critic.parameters(), config.critic_rate, fused=True)
        self._dual_adam = self.loss.duals.adam(config.loss.dual_learning_rate)
        self._updates = self._critic_updates = 0

    @property
    def product(self) -> GoalPolicy:
        """The online policy, or its moving average."""
        return self.policy if self._average is None else self._average.module

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Online and target networks, the dual variables, and the moving average if there is one."""
        average = {} if self._average is None else {"average": self._average}
        return {
            "policy": self.policy, "critic": self.critic, "duals": self.loss,
            "target_policy": self.target_policy, "target_critic": self.target_critic, **average,
        }  # fmt: skip

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of policy, critic and dual variables."""
        return {"policy": self._policy_adam, "critic": self._critic_adam, "duals": self._dual_adam}

    def own_state(self) -> State:
        """Return the random state and the number of updates, on which the targets' copies depend."""
        counts = {"updates": self._updates, "critic_updates": self._critic_updates}
        return State(counts, {"generator": self._generator.get_state()})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._updates, self._critic_updates = state.values["updates"], state.values["critic_updates"]
        self._generator.set_state(state.tensors["generator"])

    def weights(self) -> Mapping[str, Tensor]:
        """Return those of the policy that acts."""
        return self.product.state_dict()

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> Scalars:
        """Take one step of the critic, and one of the policy unless the batch was refused."""
        config, batch = self.config, put_on(batch, self.policy.device)
        beside = _beside(batch)
        # A number that is not finite in one of two batches refuses both.
        if beside and not guard.accept(*batch.values(), part="batch"):
            return {}
        draws = None if self._updates < config.critic_first else self._draw(batch)
        if beside:
            stats, accepted = self._update_critic(beside, guard)
        else:
            loss = self._critic_loss(batch, self._value_of_play(batch) if draws is None else self._value(batch, draws))
            stats = {"loss/critic": float(loss.detach())}
            accepted = self._step_critic(loss, guard)
        if accepted and draws is not None:
            stats |= self._update_policy(batch, draws, guard)
        if accepted and self._updates < config.normalised:
            self._normalise(batch)
        self._updates += accepted
        if accepted and self._updates % config.target_period == 0:
            self.target_policy.load_state_dict(self.product.state_dict())
            if not beside:
                self.target_critic.load_state_dict(self.critic.state_dict())
        return stats

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the best product, and the critic as it is, with which MPO of another policy may begin."""
        super().export(directory, record)
        save_weights(directory.path / "critic.safetensors", self.critic, self.critic.config, record)

    def _update_critic(self, beside: Batch, guard: NaNGuard) -> tuple[dict[str, float], bool]:
        """Take the critic's own steps, from windows [K, M, W, ...]; return whether none was refused."""
        losses, accepted = [], True
        for k in range(len(beside["reward"])):
            batch = {name: values[k] for name, values in beside.items()}
            loss = self._critic_loss(batch, self._value_of_players(batch))
            losses.append(float(loss.detach()))
            accepted &= self._step_critic(loss, guard)
            self._critic_updates += 1
            if self._critic_updates % self.config.target_period == 0:
                self.target_critic.load_state_dict(self.critic.state_dict())
        return {"loss/critic": sum(losses) / len(losses)}, accepted

    def _step_critic(self, loss: Tensor, guard: NaNGuard) -> bool:
        return guarded_step(loss, [self._critic_adam], guard, clip=self.config.clip, part="critic") is not None

    @torch.no_grad()
    def _value_of_players(self, batch: Batch) -> Tensor:
        """Return the values, in the last W - n ticks, of the policies that played them, [M, W - n]."""
        n = self.config.n_step
        mean, scale = batch["mean"][:, n:], batch["scale"][:, n:]
        action = mean + scale * paired_noise(self.config.samples, mean, self._generator)
        return self.target_critic(batch["features"][:, n:], action).mean(0)

    @torch.no_grad()
    def _draw(self, batch: Batch) -> _Draws:
        """Return actions of the target policy in the last W - n ticks, with their values."""
        config = self.config
        target = self.target_policy.over_windows(batch, config.n_step)
        action = target.mean + target.scale * paired_noise(config.samples, target.mean, self._generator)
        q = self.target_critic(batch["features"][:, config.n_step :], action)
        return _Draws(target, action, q)

    def _value(self, batch: Batch, draws: _Draws) -> Tensor:
        """Return the values of the policy in the last W - n ticks, [M, W - n]; where another drove, of what he did."""
        value = draws.q.mean(0)
        if "driven" not in batch:
            return value
        return torch.where(batch["driven"][:, self.config.n_step :], value, self._value_of_play(batch))

    @torch.no_grad()
    def _value_of_play(self, batch: Batch) -> Tensor:
        """Return the values of what was done in the last W - n ticks, [M, W - n]."""
        n = self.config.n_step
        return self.target_critic(batch["features"][:, n:], batch["action"][:, n:])

    def _normalise(self, batch: Mapping[str, Tensor]) -> None:
        """Take in what is seen, for online and target networks alike: what they compute would differ otherwise."""
        self.critic.normaliser.update(batch["features"][:, 0])
        self.target_critic.normaliser.load_state_dict(self.critic.normaliser.state_dict())
        averages = () if self._average is None else (self._average.module,)
        for policy in (self.policy, self.target_policy, *averages):
            policy.normalise(batch)

    def _critic_loss(self, batch: Mapping[str, Tensor], value: Tensor) -> Tensor:
        """Return the squared error of Q in the first W - n ticks, given V in the last W - n, [M, W - n]."""
        n = self.config.n_step
        starts = value.shape[1]
        # Shape [M * (W - n), n].
        reward, discount, truncated = (
            batch[k].unfold(1, n, 1)[:, :starts].flatten(0, 1) for k in ("reward", "discount", "truncated")
        )
        target = td_target(reward, discount, value.flatten(), self.config.gamma)
        predicted = self.critic(batch["features"][:, :starts], batch["action"][:, :starts]).flatten()
        # Nobody knows what would have come after an episode that was cut off; behind an end that does not matter.
        counts = torch.cat([torch.ones_like(discount[:, :1]), discount.cumprod(1)[:, :-1]], 1) > 0.0
        known = ~(truncated & counts).any(1)
        return (functional.mse_loss(predicted, target, reduction="none") * known).sum() / known.sum().clamp(min=1)

    def _update_policy(self, batch: Batch, draws: _Draws, guard: NaNGuard) -> dict[str, float]:
        target, action, q = draws
        online = self.policy.over_windows(batch, self.config.n_step)
        driven = batch["driven"][:, self.config.n_step :] if "driven" in batch else torch.ones_like(q[0]).bool()
        if not driven.any():
            return {}
        loss, stats = self.loss(
            (online.mean[driven], online.scale[driven]), (target.mean[driven], target.scale[driven]),
            action[:, driven], q[:, driven],
        )  # fmt: skip
        norm = guarded_step(loss, [self._policy_adam, self._dual_adam], guard, clip=self.config.clip, part="policy")
        if norm is not None and self._average is not None:
            self._average.update_parameters(self.policy)
        named = scalars(stats._asdict())
        return named if norm is None else {**named, "gradient_norm": float(norm)}
