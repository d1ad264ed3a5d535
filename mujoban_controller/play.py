"""Players: what acts in the goal task while others learn from it, tick by tick into a replay.

Shapes: B robots, R recorded rows, M windows of a batch, W ticks of a window, D features, U actuators.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_controller.controller import INPUT_FIELDS, MEMORY_FIELDS, Recurrent, VisuomotorController
from mujoban_controller.goal_task import GoalTask, Outcome, TaskStep
from mujoban_controller.judge import OutcomeSummary
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.interfaces import ControllerInput, Memory, renew_rows
from mujoban_rl.engine import Scalars, Source, State
from mujoban_rl.replay import TickReplay

Fields = dict[str, NDArray]
Batch = dict[str, Tensor]


def put_on(batch: Batch, device: torch.device) -> Batch:
    """Return a batch on a device. Replays are in the machine's memory; frames travel as bytes."""
    return {name: values.to(device) for name, values in batch.items()}


def _outcome(step: TaskStep) -> Fields:
    return {"reward": step.reward, "discount": step.discount, "truncated": step.truncated}


class Player(ABC):
    """Gives ticks to learn from, with a policy of its own, whose weights `take` renews."""

    @abstractmethod
    def tick(self) -> tuple[Fields, Sequence[Outcome]]:
        """Play one tick; return what is to be kept of it, [B, ...] each, and the instructions that ended."""

    @abstractmethod
    def take(self, weights: Mapping[str, Tensor]) -> None:
        """Act with these weights from now on."""

    @abstractmethod
    def state(self) -> State:
        """Return all that changes but the weights."""

    @abstractmethod
    def restore(self, state: State) -> None:
        """Take over what `state` returned."""

    @abstractmethod
    def close(self) -> None:
        """Free what it holds."""


class TaskPlayer(Player):
    """Acts in the goal task."""

    task: GoalTask

    def state(self) -> State:
        """Return all that changes but the weights."""
        return State.of({"task": self.task.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.task.restore(state.part("task"))

    def close(self) -> None:
        """Free the cameras."""
        self.task.world.close()


class PrivilegedPlayer(TaskPlayer):
    """A privileged policy that explores."""

    def __init__(
        self, task: GoalTask, policy: PrivilegedPolicy, generator: torch.Generator, explore: float = 0.0,
        steady: float = 0.0,
    ) -> None:  # fmt: skip
        """Play with a copy of `policy` and noise from `generator`; the torques of every third robot deviate more.

        By `explore` at least; those of a share of the robots, which is `steady`, do not deviate.
        """
        self.task, self._generator, self._explore = task, generator, explore
        self._steady = steady
        self._policy = PrivilegedPolicy(**policy.config)
        self._features: NDArray[np.float32] = task.features()

    @torch.no_grad()
    def tick(self) -> tuple[Fields, Sequence[Outcome]]:
        """Play one tick."""
        features = self._features
        drawn = self._policy(torch.from_numpy(features))
        scale = steadied(drawn.scale, self._steady)
        action = drawn_torque(drawn.mean, scale, self._explore, self._generator)
        result = self.task.step(action)
        self._features = self.task.features()
        kept = {"features": features, "action": action, **_outcome(result)}
        return kept, result.outcomes

    def take(self, weights: Mapping[str, Tensor]) -> None:
        """Act with these weights from now on."""
        self._policy.load_state_dict(dict(weights))

    def state(self) -> State:
        """Return all that changes but the weights."""
        own = State(tensors={"generator": self._generator.get_state()})
        return State.of({"task": self.task.state(), "noise": own})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        super().restore(state)
        self._generator.set_state(state.part("noise").tensors["generator"])
        self._features = self.task.features()


class CameraPlayer(TaskPlayer):
    """A camera policy with its memory; what it makes of its distribution over torques is up to subclasses."""

    def __init__(self, task: GoalTask, policy: VisuomotorController, generator: torch.Generator) -> None:
        """Play with a copy of `policy`, where it is, and randomness from `generator`, which is on the CPU."""
        self.task, self.generator = task, generator
        self._policy = deepcopy(policy)
        self._memory: Memory = self._policy.initial_memory(task.world.batch)

    @property
    def policy(self) -> VisuomotorController:
        """The copy that acts."""
        return self._policy

    @torch.no_grad()
    def tick(self) -> tuple[Fields, Sequence[Outcome]]:
        """Play one tick."""
        task, first = self.task, self.task.first.copy()
        memory = renew_rows(self._memory, self._policy.initial_memory(len(first)), first)
        inputs = task.observe()
        output = self._policy(*self._policy.to_tensors(inputs), memory=Recurrent(*memory))
        self._memory = output.memory
        kept: Fields = {name: getattr(inputs, name) for name in INPUT_FIELDS}
        kept |= {name: m.cpu().numpy() for name, m in zip(MEMORY_FIELDS, memory, strict=True)}
        torque, extra = self._act(inputs, *(x[:, 0].cpu() for x in output.action))
        result = task.step(torque)
        kept |= {"first": first, **extra, **_outcome(result)}
        return kept, result.outcomes

    @abstractmethod
    def _act(self, inputs: ControllerInput, mean: Tensor, scale: Tensor) -> tuple[NDArray[np.float32], Fields]:
        """Return the torques to apply, [B, U], and what else is to be kept of the tick; `mean` is on the CPU."""

    def take(self, weights: Mapping[str, Tensor]) -> None:
        """Act with these weights from now on."""
        self._policy.load_state_dict(dict(weights))

    def state(self) -> State:
        """Return all that changes but the weights."""
        memory = {name: m for name, m in zip(MEMORY_FIELDS, self._memory, strict=True)}
        own = State(tensors={"generator": self.generator.get_state(), **memory})
        return State.of({"task": self.task.state(), "policy": own})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        super().restore(state)
        tensors = state.part("policy").tensors
        self.generator.set_state(tensors["generator"])
        self._memory = Recurrent(*(tensors[name].to(self._policy.device) for name in MEMORY_FIELDS))


class ExploringPlayer(CameraPlayer):
    """A camera policy that draws its torques, for MPO with an asymmetric critic."""

    def __init__(
        self, task: GoalTask, policy: VisuomotorController, generator: torch.Generator, explore: float = 0.0,
        steady: float = 0.0,
    ) -> None:  # fmt: skip
        """Play with a copy of `policy`; the torques of every third robot deviate by `explore` at least.

        A share of the robots is `steady`: theirs do not deviate.
        """
        super().__init__(task, policy, generator)
        self._explore, self._steady = explore, steady

    def _act(self, inputs: ControllerInput, mean: Tensor, scale: Tensor) -> tuple[NDArray[np.float32], Fields]:
        scale = steadied(scale, self._steady)
        torque = drawn_torque(mean, scale, self._explore, self.generator)
        seen = {"features": self.task.features(), "action": torque}
        return torque, {**seen, "mean": mean.numpy(), "scale": scale.numpy()}


def steadied(scale: Tensor, share: float) -> Tensor:
    """Return scales, [B, U], that are 0 for about that share of the robots: they play by the mean of their policy."""
    return scale.masked_fill(_steady(len(scale), share), 0.0)


@cache
def _steady(batch: int, share: float) -> Tensor:
    """Return which of so many robots they are, [B, 1]."""
    count = torch.arange(batch + 1, dtype=torch.float64) * share
    return (count.floor().diff() > 0.0)[:, None]


def drawn_torque(
    mean: Tensor, scale: Tensor, explore: float, generator: torch.Generator
) -> NDArray[np.float32]:
    """Return torques that are drawn, limited to [-1, 1], [B, U]; of every third robot with `explore` at least.

    Where `scale` is 0 they are the mean.
    """
    third = torch.arange(len(mean)) % 3 == 0
    least = torch.where(third[:, None] & (scale > 0.0), explore, 0.0)
    noise = torch.randn(mean.shape, generator=generator)
    return (mean + torch.maximum(scale, least) * noise).clamp(-1.0, 1.0).numpy()


CRITIC_FIELDS = ("features", "action", "reward", "discount", "truncated", "mean", "scale")
"""What a critic learns from that sees no frames; `mean` and `scale` are of the policy that played."""
CRITIC = "critic/"
"""Begins the names of these fields in a batch, in windows of their own."""


@dataclass(frozen=True)
class CriticDraw:
    """What a critic's batches are drawn from, and how."""

    capacity: int
    """Sequences in its replay, which has no frames."""
    window: int
    """Ticks of its windows."""
    updates: int
    """K, between two of the policy."""
    windows: int
    """M of each."""


@dataclass(frozen=True)
class Draw:
    """What is drawn from a replay, and how often."""

    capacity: int
    """Sequences in the replay."""
    length: int
    """Ticks of a sequence."""
    window: int
    """W."""
    windows: int
    """M."""
    per_tick: float
    """Batches for each tick played."""
    first: int
    """Ticks played before the first batch."""
    critic: CriticDraw | None = None
    """What is drawn for a critic beside it."""


class ReplaySource(Source[Batch]):
    """Windows of W successive ticks, drawn evenly from what a player has played last, and from recordings beside it."""

    def __init__(
        self, player: Player, draw: Draw, generator: torch.Generator, recorded: Player | None = None
    ) -> None:
        """Play and draw.

        Args:
            player: Adds B rows to each tick.
            draw: How batches are drawn.
            generator: Draws windows.
            recorded: Gives ticks of recordings, which are kept beside those of the player, [R, ...] each.
        """
        self._player, self._draw, self._generator, self._recorded = player, draw, generator, recorded
        self._replay = TickReplay(draw.capacity, draw.length, draw.window)
        critic = draw.critic
        self._long = None if critic is None else TickReplay(critic.capacity, draw.length, critic.window)
        self._due, self._ticks = 0.0, 0
        self._summary = OutcomeSummary()

    @property
    def player(self) -> Player:
        """Who plays."""
        return self._player

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Let the player act with these weights, and the recordings' memory be theirs."""
        self._player.take(weights)
        if self._recorded is not None:
            self._recorded.take(weights)

    def next_batch(self) -> Batch:
        """Play until a batch is due; return windows, [M, W, ...] each, and those for the critic, [K, M, W, ...]."""
        while self._due < 1.0 or not self._replay.added:
            self._play()
        self._due -= 1.0
        batch = self._replay.sample(self._draw.windows, self._generator)
        critic = self._draw.critic
        if self._long is None or critic is None:
            return batch
        beside = self._long.sample(critic.updates * critic.windows, self._generator)
        return batch | {CRITIC + name: x.unflatten(0, (critic.updates, critic.windows)) for name, x in beside.items()}

    def _play(self) -> None:
        tick, outcomes = self._player.tick()
        self._summary.add(outcomes)
        self.samples += len(tick["reward"])
        if self._recorded is not None:
            beside, _ = self._recorded.tick()
            tick = {name: np.concatenate([values, beside[name]]) for name, values in tick.items()}
        self._replay.add(tick)
        if self._long is not None:
            self._long.add({name: tick[name] for name in CRITIC_FIELDS})
        self._ticks += 1
        if self._ticks >= self._draw.first:
            self._due += self._draw.per_tick

    def statistics(self) -> Scalars:
        """Return how instructions went since the last call."""
        summary, self._summary = self._summary, OutcomeSummary()
        return summary.scalars()

    def state(self) -> State:
        """Return the replay, the player's state and what draws from them."""
        own = State({"due": self._due, "ticks": self._ticks}, {"generator": self._generator.get_state()})
        parts = {"player": self._player.state(), "replay": self._replay.state()}
        if self._recorded is not None:
            parts["recorded"] = self._recorded.state()
        if self._long is not None:
            parts["long"] = self._long.state()
        return State.of({**parts, "own": own})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._player.restore(state.part("player"))
        if self._recorded is not None:
            self._recorded.restore(state.part("recorded"))
        self._replay.restore(state.part("replay"))
        if self._long is not None:
            self._long.restore(state.part("long"))
        own = state.part("own")
        self._due, self._ticks = own.values["due"], own.values["ticks"]
        self._generator.set_state(own.tensors["generator"])

    def close(self) -> None:
        """Free what the player holds."""
        self._player.close()
