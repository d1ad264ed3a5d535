"""Monolithic MPO (paper D.1): windows of a replay, n-step returns, the overall reward.

The agent's memory at the start of a window is the one that it had when the window was played; in the first ticks it is
brought up to date, and nothing is learned there (Kapturowski et al. 2019).

Shape legend: M windows of a batch, W ticks of a window, b ticks that warm up, n steps of a return, N sampled actions,
U actuators.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from mujoban_baselines.actor import memory_of
from mujoban_baselines.critics import Critic
from mujoban_baselines.networks import AgentOutput, RecurrentAgent
from mujoban_core.ranges import check_counts, check_positive, check_shares
from mujoban_rl.actors import ReplayStore
from mujoban_rl.engine import Learner, Scalars, State
from mujoban_rl.exploration import Exploration, check_exploration
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_continuous import MPOConfig, MPOLoss, check_samples, paired_noise
from mujoban_rl.losses.returns import Returns, windowed_returns
from mujoban_rl.optimise import guarded_step
from mujoban_rl.replay import SequenceReplay, steps_per_update
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import save_weights

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class MPOTrainingConfig:
    """Settings of MPO; where not said otherwise those of Acme."""

    window: int = 40
    """W, decisions of a window."""
    warm_up: int = 4
    """b, decisions of burn-in at a window's start, which bring the memory up to date and teach nothing."""
    windows: int = 10
    """M, windows of a batch."""
    replay: int = 32_000
    """Decisions in the replay; each is a frame, and checkpoints carry them."""
    first: int = 8_000
    """Environment steps before the first update."""
    reuse: float = 1.0
    """Times that each step is learned from, on average."""
    exploration: Exploration = "pink"
    """Noise of the torques that are tried: white noise finds no reward here."""
    n_step: int = 5
    """n of the n-step returns: rewards before they bootstrap from the critic."""
    samples: int = 20
    """N, actions drawn in each state for the E-step."""
    gamma: float = 0.99
    """Discount from one decision to the next."""
    target_period: int = 20
    """Updates between copies to the target networks; from copy to copy the policy moves by the bounds of the loss."""
    rate: float = 3e-4
    """Learning rate of agent and critic."""
    clip: float = 40.0
    """Largest norm of the gradient."""
    critic_first: int = 0
    """Updates in which the critic learns alone; an agent that can something already needs it."""
    normalised: int = 500
    """Updates after which the normalisation of proprioception stays as it is."""
    loss: MPOConfig = field(
        default_factory=lambda: MPOConfig(epsilon_mean=0.01, epsilon_scale=1e-4, initial_temperature=1.0)
    )
    """Wider bounds than Acme's, and copies sooner: updates are few here."""

    def __post_init__(self) -> None:
        """Reject windows in which nothing is learned, an odd number of samples, and numbers out of their range."""
        check_samples(self.samples)
        check_exploration(self.exploration)
        check_counts(self, "windows", "n_step", "target_period", "replay")
        check_counts(self, "warm_up", "first", "critic_first", "normalised", least=0)
        check_shares(self, "gamma")
        check_positive(self, "gamma", "reuse", "rate", "clip")
        if self.window <= self.overlap:
            raise ValueError(
                f"window is {self.window}: expected more than warm_up {self.warm_up} and n_step {self.n_step}"
            )

    @property
    def overlap(self) -> int:
        """Ticks that a sequence shares with the one before, so that each tick is the start of a return once."""
        return self.warm_up + self.n_step

    @property
    def steps_per_update(self) -> float:
        """Decisions that are collected for each update."""
        return steps_per_update(self.windows, self.window - self.overlap, self.reuse)


class WindowStore(ReplayStore[Batch]):
    """Whole sequences of the last steps, drawn evenly."""

    def __init__(self, config: MPOTrainingConfig, generator: torch.Generator) -> None:
        """Hold the replay of a configuration; `generator` draws."""
        new = config.window - config.overlap
        super().__init__(SequenceReplay(max(config.replay // new, config.windows), config.window), generator)
        self._windows = config.windows

    def sample(self) -> Batch:
        """Return windows, [M, W, ...] each."""
        return self.replay.sample(self._windows, self.generator)


class MPOLearner(Learner[Batch]):
    """Online and target networks, and dual variables."""

    def __init__(
        self, agent: RecurrentAgent, critic: Critic, config: MPOTrainingConfig, generator: torch.Generator
    ) -> None:
        """Train `agent` in place.

        Args:
            agent: The policy.
            critic: Its critic.
            config: Settings.
            generator: Draws the actions of the E-step.
        """
        self.agent, self.critic, self.config, self._generator = agent, critic, config, generator
        agent.mixed_precision = True
        self.loss = MPOLoss(agent.action_size, config.loss)
        self.target_agent, self.target_critic = deepcopy(agent), deepcopy(critic)
        self._adam = torch.optim.Adam([*agent.parameters(), *critic.parameters()], config.rate, fused=True)
        self._dual_adam = self.loss.duals.adam(config.loss.dual_learning_rate)
        self._updates = 0
        # Targets are computed beside what the online agent says, on what the actors leave of the cores.
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="target")

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Online and target networks and the dual variables."""
        return {
            "agent": self.agent, "critic": self.critic, "duals": self.loss,
            "target_agent": self.target_agent, "target_critic": self.target_critic,
        }  # fmt: skip

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of the networks and of the dual variables."""
        return {"networks": self._adam, "duals": self._dual_adam}

    def state(self) -> State:
        """Return the random state and the number of updates, on which the targets' copies depend."""
        return State({"updates": self._updates}, {"generator": self._generator.get_state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._updates = state.values["updates"]
        self._generator.set_state(state.tensors["generator"])

    def weights(self) -> Mapping[str, Tensor]:
        """Return the agent's."""
        return self.agent.state_dict()

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the agent."""
        save_weights(directory.path / "agent.safetensors", self.agent, self.agent.config, record)

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> Scalars:
        """Take one step of agent, critic and dual variables."""
        config, warm = self.config, self.config.warm_up
        weighed = self._beside.submit(self._weigh, batch)
        online = self._over(self.agent, batch, warm)
        target, action, q = weighed.result()
        alone = self._updates < config.critic_first
        # Alone, it must not change the torso that it may share with the policy.
        critic_loss = self._critic_loss(batch, online.features.detach() if alone else online.features, q.mean(0))
        policy = online.action
        if self.critic.teaches_torso:
            # Each change that the critic makes to the torso would be one of the policy, and the bounds on these stop
            # it; so the policy learns on the features that the target has, as in Acme's agents from pixels.
            policy = self.agent.distribution(target.features[:, warm:])
        policy_loss, stats = self.loss(
            _flat(policy), _flat(x[:, warm:] for x in target.action),
            action[:, :, warm:].flatten(1, 2), q[:, :, warm:].flatten(1),
        )  # fmt: skip
        loss = critic_loss if alone else critic_loss + policy_loss
        norm = guarded_step(loss, [self._adam, self._dual_adam], guard, clip=config.clip)
        if norm is None:
            return {}
        self._normalise(batch)
        self._updates += 1
        if self._updates % config.target_period == 0:
            self.target_agent.load_state_dict(self.agent.state_dict())
            self.target_critic.load_state_dict(self.critic.state_dict())
        return {"loss/critic": float(critic_loss.detach()), **scalars(stats._asdict()), "gradient_norm": float(norm)}

    @torch.no_grad()
    def _weigh(self, batch: Batch) -> tuple[AgentOutput, Tensor, Tensor]:
        """Return what the target agent says, actions drawn from it, [N, M, W, U], and their values, [N, M, W]."""
        target = self._over(self.target_agent, batch, 0)
        noise = paired_noise(self.config.samples, target.action.mean, self._generator)
        action = target.action.mean + target.action.scale * noise
        return target, action, self.target_critic(self.target_critic.state(batch, target.features), action)

    def _over(self, agent: RecurrentAgent, batch: Batch, skipped: int) -> AgentOutput:
        """Return an agent's output in the ticks of windows from number `skipped` on, [M, W - skipped, ...]."""
        sights = {name: batch[name] for name in self.agent.reads}
        memory, first = memory_of(batch), batch["first"]
        if skipped:
            with torch.no_grad():
                before = {name: values[:, :skipped] for name, values in sights.items()}
                memory = agent(before, memory, first[:, :skipped]).memory
        return agent({name: values[:, skipped:] for name, values in sights.items()}, memory, first[:, skipped:])

    def _critic_loss(self, batch: Batch, features: Tensor, value: Tensor) -> Tensor:
        """Return half the mean squared error of Q in the ticks that a return starts from, given V [M, W]."""
        warm, n = self.config.warm_up, self.config.n_step
        starts = value.shape[1] - warm - n
        later = {name: values[:, warm:] for name, values in batch.items()}
        returns = self._returns(later, starts)
        # V of the state that each return goes on from, [M * starts].
        reached = torch.arange(starts).repeat(len(value)) + returns.index
        row = torch.arange(len(value)).repeat_interleave(starts)
        target = returns.reward + returns.bootstrap * value[row, warm + reached]
        begun = {name: later[name][:, :starts] for name in (*self.critic.sees, "action")}
        state = self.critic.state(begun, features[:, :starts])
        predicted = self.critic(state, begun["action"]).flatten()
        # What was dropped may be followed by anything.
        error = torch.where(returns.valid, predicted - target, 0.0)
        return 0.5 * error.square().sum() / returns.valid.sum().clamp(min=1)

    def _returns(self, later: Batch, starts: int) -> Returns:
        """Return n-step returns from the first `starts` ticks, [M * starts]; a step that ran out of time is dropped."""
        reward, terminated, truncated = (
            later[name].unfold(1, self.config.n_step, 1)[:, :starts].flatten(0, 1)
            for name in ("reward", "terminated", "truncated")
        )
        return windowed_returns(reward, terminated, truncated, self.config.gamma)

    def _normalise(self, batch: Batch) -> None:
        """Take in what is felt, for online and target networks alike: what they compute would differ otherwise."""
        senses = (self.agent.sense, self.target_agent.sense), (self.critic.sense, self.target_critic.sense)
        for online, target in senses:
            if online is None or target is None:
                continue
            if online.meet(batch["proprio"][:, 0], self.config.normalised):
                target.normaliser.load_state_dict(online.normaliser.state_dict())


def _flat(pair: Any) -> tuple[Tensor, Tensor]:
    """Return mean and scale over windows and ticks as over states, [M * W, U] each."""
    mean, scale = (x.flatten(0, 1) for x in pair)
    return mean, scale
