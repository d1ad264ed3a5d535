"""V-trace (paper D.2) on the unrolls of actors: the overall reward, and the pseudo reward of subgoals where there are.

Shape legend: T steps of an unroll, which holds T + 1 ticks, B robots. A tick is one in which the agent decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn import functional

from mujoban_baselines.actor import memory_of
from mujoban_baselines.networks import RecurrentAgent
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_rl.actors import Arrays
from mujoban_rl.engine import Learner, Scalars
from mujoban_rl.exploration import Exploration, check_exploration
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.vtrace import VTraceConfig, VTraceStats, vtrace_loss
from mujoban_rl.optimise import ProgressSchedule, guarded_step
from mujoban_rl.progress import Meter
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import save_weights


@dataclass(frozen=True)
class VTraceTrainingConfig:
    """Settings of V-trace (Espeholt et al. 2018)."""

    unroll: int = 20
    """T, in decisions of the agent."""
    batch: int = 8
    """Robots of whose unrolls each step of the optimiser learns, of all that have played until each has had its turn.
    The later steps' weights are newer than those that played, which importance weights correct for."""
    gamma: float = 0.99
    """Discount from one decision to the next."""
    rate: float = 3e-4
    """Learning rate; it falls to 0 along a line."""
    clip: float = 40.0
    """Largest norm of the gradient."""
    auxiliary: float = 0.5
    """Weight of the loss of subgoals (paper D.2), which structured-vtrace alone has."""
    beyond: float = 0.05
    """Weight of the squares by which mean torques are beyond their limits: from where all draws are one to the world
    no reward leads back."""
    normalised: int = 500
    """Updates after which the normalisation of proprioception stays as it is."""
    exploration: Exploration = "white"
    """How alike the noise of successive ticks is. What is noted of a draw is its probability alone, given no other:
    with pink noise learning is on-policy only approximately."""
    loss: VTraceConfig = field(default_factory=VTraceConfig)

    def __post_init__(self) -> None:
        """Reject unrolls without a step, batches of nobody, and numbers out of their range."""
        check_counts(self, "unroll", "batch")
        check_shares(self, "gamma")
        check_positive(self, "gamma", "rate", "clip")
        check_not_negative(self, "auxiliary", "beyond")
        check_exploration(self.exploration)

    @property
    def length(self) -> int:
        """Ticks of an unroll; the last is only bootstrapped from, and is the first of the next."""
        return self.unroll + 1


class VTraceLearner(Learner[Arrays]):
    """An agent, and values on its torso."""

    def __init__(self, agent: RecurrentAgent, config: VTraceTrainingConfig) -> None:
        """Train `agent` in place."""
        self.agent, self.config = agent, config
        agent.mixed_precision = True
        self.value, self.pseudo_value = (nn.Linear(agent.width, 1) for _ in range(2))
        parameters = [p for module in self.modules.values() for p in module.parameters()]
        self._adam = torch.optim.Adam(parameters, config.rate, fused=True)
        self._schedule = ProgressSchedule(self._adam, lambda progress: 1.0 - progress)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """The agent and the two value heads."""
        return {"agent": self.agent, "value": self.value, "pseudo_value": self.pseudo_value}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Adam."""
        return {"adam": self._adam}

    def weights(self) -> Mapping[str, Tensor]:
        """Return the agent's."""
        return self.agent.state_dict()

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the agent."""
        save_weights(directory.path / "agent.safetensors", self.agent, self.agent.config, record)

    def update(self, batch: Arrays, progress: float, guard: NaNGuard) -> Scalars:
        """Learn from the unrolls of all actors, [T + 1, B, ...] each."""
        self._schedule.follow(progress)
        # Shape [B, T + 1, ...].
        ticks = {name: torch.from_numpy(values).transpose(0, 1) for name, values in batch.items()}
        meter, batch_size = Meter(), self.config.batch
        for start in range(0, len(ticks["first"]), batch_size):
            part = {name: values[start : start + batch_size] for name, values in ticks.items()}
            meter.add(self._learn(part, guard))
        if meter and (sense := self.agent.sense) is not None:
            sense.meet(ticks["proprio"][:, 0], self.config.normalised)
        return meter.take()

    def _learn(self, ticks: Mapping[str, Tensor], guard: NaNGuard) -> dict[str, float]:
        """Take a step on some robots' unrolls, [B, T + 1, ...] each; return what to log, nothing if it was refused."""
        output = self.agent({name: ticks[name] for name in self.agent.reads}, memory_of(ticks), ticks["first"])
        log_prob = output.action.limited_log_prob(ticks["action"])
        entropy = Normal(*output.action, validate_args=False).entropy().sum(-1)
        over = ticks["terminated"] | ticks["truncated"]
        value = self.value(output.features).squeeze(-1)
        # A state from which time ran out is worth what it is held to be, and its step teaches nothing.
        reward = torch.where(ticks["truncated"], value.detach(), ticks["reward"])
        loss, stats = self._loss(log_prob, ticks["log_prob"], entropy, value, reward, over)
        named = {f"vtrace/{name}": float(number) for name, number in stats._asdict().items()}
        beyond = functional.relu(output.action.mean.abs() - 1.0).square().sum(-1).mean()
        loss = loss + self.config.beyond * beyond
        named["vtrace/beyond"] = float(beyond.detach())
        if "pseudo_reward" in ticks:
            pseudo = self.pseudo_value(output.features).squeeze(-1)
            # The policy is one, and so is the bonus for its entropy.
            extra, aside = self._loss(
                log_prob, ticks["log_prob"], torch.zeros_like(entropy), pseudo, ticks["pseudo_reward"],
                ticks["pseudo_over"],
            )  # fmt: skip
            loss = loss + self.config.auxiliary * extra
            earned = ticks["pseudo_reward"].mean()
            named |= {"subgoal/value_loss": float(aside.value_loss), "subgoal/reward": float(earned)}
        norm = guarded_step(loss, [self._adam], guard, clip=self.config.clip)
        if norm is None:
            return {}
        scale = float(output.action.scale.detach().mean())
        return {**named, "vtrace/scale": scale, "gradient_norm": float(norm)}

    def _loss(
        self, log_prob: Tensor, behaviour: Tensor, entropy: Tensor, value: Tensor, reward: Tensor, over: Tensor
    ) -> tuple[Tensor, VTraceStats]:
        """Return the loss of a reward whose returns end where `over`, all of them [B, T + 1]."""
        discount = self.config.gamma * (~over).to(reward.dtype)
        log_pi, log_mu, spread, v, r, gamma = (
            x[:, :-1].T for x in (log_prob, behaviour, entropy, value, reward, discount)
        )
        return vtrace_loss(log_pi, log_mu, spread, v, value[:, -1], r, gamma, self.config.loss)
