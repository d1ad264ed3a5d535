"""Discrete MPO for networks that answer states with a policy and Q-values (paper C.2): settings, replay, learner.

n-step returns off-policy from a replay train the Q head, discrete MPO the policy head.

Shapes: B batch, A actions; states of any shape `...`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_planner.teacher import DISCOUNT
from mujoban_rl.actors import ReplayStore
from mujoban_rl.best import JudgedLearner
from mujoban_rl.engine import State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_discrete import DiscreteMPO, DiscreteMPOConfig, expected_value
from mujoban_rl.losses.returns import windowed_returns
from mujoban_rl.optimise import guarded_step
from mujoban_rl.precision import autocast
from mujoban_rl.replay import SequenceReplay

_CLIP: Final = 40.0
"""Largest norm of the gradient."""


@dataclass(frozen=True)
class MPOSettings:
    """What defines replay and learning."""

    environments: int = 256
    """Levels that an actor plays at once."""
    play: int = 10
    """Instructions in each level between two deliveries of an actor."""
    n_step: int = 5
    """Instructions of a return; as many are delivered once more with the next sequence."""
    mpo: DiscreteMPOConfig = field(default_factory=DiscreteMPOConfig)
    steps_per_update: float = 1.0
    """Instructions in each of `environments` levels per update."""
    replay_steps: int = 400
    """Instructions in each of `environments` levels that are kept."""
    warm_up_steps: int = 40
    """Instructions in each of `environments` levels before the first update."""
    batch_size: int = 256
    discount: float = DISCOUNT
    """Discount from one move to the next."""
    learning_rate: float = 1e-4
    """Learning rate."""
    dual_learning_rate: float = 1e-2
    """Learning rate of temperatures and multipliers."""
    target_period: int = 100
    """Updates between copies to the target network."""
    q_weight: float = 0.5
    """Weight of the critic's loss."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is played or learned, and what is no share."""
        check_counts(self, "environments", "play", "n_step", "replay_steps", "batch_size", "target_period")
        check_counts(self, "seed", least=0)
        check_positive(self, "steps_per_update", "learning_rate", "dual_learning_rate")
        check_not_negative(self, "warm_up_steps", "q_weight")
        check_shares(self, "discount")


class MPOBatch(NamedTuple):
    """Instructions that were executed, with what came of them."""

    state: Tensor
    """float32 [B, ...]."""
    instruction: Tensor
    """int64 [B]."""
    reward: Tensor
    """Discounted reward of up to n instructions, float32 [B]."""
    bootstrap: Tensor
    """Discount of the value of `last`, 0 where the episode terminated, float32 [B]."""
    last: Tensor
    """States from which the value goes on, float32 [B, ...]."""
    valid: Tensor
    """False where the instruction failed, bool [B]."""

    def to(self, device: torch.device) -> MPOBatch:
        """Return the batch on a device."""
        return MPOBatch._make(values.to(device, non_blocking=True) for values in self)


class StepStore(ReplayStore[MPOBatch]):
    """Replay of what actors played: `state`, `instruction`, `reward`, `terminated`, `dropped`."""

    def __init__(self, config: MPOSettings) -> None:
        """Start empty."""
        self._config = config
        capacity = max(1, config.replay_steps * config.environments // config.play)
        generator = torch.Generator().manual_seed(config.seed)
        super().__init__(SequenceReplay(capacity, config.play + config.n_step), generator)

    def sample(self) -> MPOBatch:
        """Return a batch with n-step returns."""
        return self._played(self._config.batch_size)

    def _played(self, count: int) -> MPOBatch:
        window = self.replay.sample(count, self.generator, self._config.n_step + 1)
        reward, terminated, dropped = (window[name][:, :-1] for name in ("reward", "terminated", "dropped"))
        returns = windowed_returns(reward, terminated, dropped, self._config.discount)
        last = window["state"][torch.arange(count), returns.index]
        state, instruction = window["state"][:, 0].float(), window["instruction"][:, 0]
        return MPOBatch(state, instruction, returns.reward, returns.bootstrap, last.float(), returns.valid)


class Answer(Protocol):
    """What a network says about states."""

    @property
    def policy(self) -> Tensor:
        """Logits, [B, A]."""
        ...

    @property
    def q(self) -> Tensor:
        """[B, A]."""
        ...


class DiscreteMPOLearner(JudgedLearner[MPOBatch]):
    """Online and target network, and the dual variables."""

    network: nn.Module
    """Answers states, float32 [B, ...], with an `Answer`."""
    target: nn.Module

    def __init__(self, config: MPOSettings, network: nn.Module, device: torch.device | str = "cpu") -> None:
        """Train `network` in place."""
        super().__init__()
        self.config, self.device = config, torch.device(device)
        self.network = network.to(self.device).train()
        self.target = copy.deepcopy(self.network).eval()
        self.mpo = DiscreteMPO(config.mpo).to(self.device)
        self._adam = torch.optim.Adam(self.network.parameters(), config.learning_rate, fused=True)
        self._dual_adam = self.mpo.duals.adam(config.dual_learning_rate)
        self._updates = 0

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Both networks and the dual variables."""
        return {"network": self.network, "target": self.target, "mpo": self.mpo}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of the network and of the dual variables."""
        return {"adam": self._adam, "duals": self._dual_adam}

    def own_state(self) -> State:
        """Return the number of updates, by which the target network follows."""
        return State({"updates": self._updates})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._updates = state.values["updates"]

    def update(self, batch: MPOBatch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step of policy, critic and dual variables."""
        batch = batch.to(self.device)
        output, before, q_loss = self.weigh(batch)
        policy_loss, stats = self.mpo(output.policy, before.policy, before.q)
        beside = self.further_losses(output, batch.state)
        loss = policy_loss + self.config.q_weight * q_loss + sum(beside.values())
        self.count(guarded_step(loss, [self._adam, self._dual_adam], guard, clip=_CLIP) is not None)
        losses = {name: value.item() for name, value in {"q_loss": q_loss, **beside}.items()}
        return {**losses, "mean_reward": batch.reward.mean().item()} | scalars(stats._asdict())

    def weigh(self, batch: MPOBatch) -> tuple[Answer, Answer, Tensor]:
        """Return what online and target network say of the states of a batch on the device, and the critic's loss."""
        with torch.no_grad(), autocast(self.device):
            before, after = self.answers(self.target, batch.state), self.answers(self.target, batch.last)
        target = batch.reward + batch.bootstrap * self.value(after)
        with autocast(self.device):
            output = self.answers(self.network, batch.state)
        taken = output.q.gather(1, batch.instruction[:, None])[:, 0]
        errors = functional.smooth_l1_loss(taken, target, reduction="none")
        return output, before, (errors * batch.valid).sum() / batch.valid.sum().clamp(min=1)

    def count(self, accepted: bool) -> None:
        """Count a step unless it was refused; the target network follows."""
        self._updates += accepted
        if accepted and self._updates % self.config.target_period == 0:
            self.target.load_state_dict(self.network.state_dict())

    def value(self, answer: Answer) -> Tensor:
        """Return what states are worth, [B]."""
        return expected_value(answer.q, answer.policy)

    def weights(self) -> Mapping[str, Tensor]:
        """Return the online network, which actors play with."""
        return self.network.state_dict()

    def answers(self, network: nn.Module, states: Tensor) -> Answer:
        """Return what the online or the target network says of states, float32 [B, ...]."""
        return network(states)

    def further_losses(self, answer: Answer, states: Tensor) -> Mapping[str, Tensor]:
        """Return what is added to the loss, by name, given what the online network said of states; nothing."""
        del answer, states
        return {}
