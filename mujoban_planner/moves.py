"""Who plays for MPO over moves: an actor in hundreds of levels of the time-abstracted task at once.

Shapes: E levels, L instructions of a sequence, N = `grid.GRID_SIZE`, A = 5 instructions.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_core.ranges import check_shares
from mujoban_planner.abstract_env import AbstractEnvironment
from mujoban_planner.boards import abstract_states
from mujoban_planner.discrete_mpo import MPOSettings
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.seed_streams import MOVES, check_seed, first_seed, stream_number
from mujoban_planner.validation import Shares, check_mix, difficulty_shares
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.precision import autocast
from mujoban_rl.replay import SequenceBuilder
from mujoban_sokoban.generator import generate_batch

_STATE: Final = (GRID_SIZE, GRID_SIZE, len(CHANNELS))


@dataclass(frozen=True)
class PlayConfig(MPOSettings):
    """What defines how an actor plays, and how is learned from it."""

    mix: Shares = (0.1, 0.1, 0.15, 0.2, 0.45)
    """Share of each difficulty among the training levels."""

    def __post_init__(self) -> None:
        """Reject what is no share, and seeds that there are not."""
        super().__post_init__()
        check_seed(self.seed, MOVES)
        check_mix(self.mix)


@dataclass(frozen=True)
class MoveConfig(PlayConfig):
    """What defines how moves are played."""

    failure_rate: float = 0.0
    """Probability that an instruction fails, as with a real controller."""

    def __post_init__(self) -> None:
        """Reject what is no share."""
        super().__post_init__()
        check_shares(self, "failure_rate")


class LevelStream:
    """Fresh training levels, one after the other."""

    def __init__(self, mix: dict[int, float], seed: int, stream: int = 0) -> None:
        """Draw difficulties by `mix`; `seed` and `stream` choose difficulties and levels.

        Raises:
            ValueError: If there is no such stream.
        """
        self.next_seed = first_seed(MOVES, stream_number(seed, stream))
        self._rng = np.random.default_rng([seed, 2, stream])
        self._difficulties, shares = np.array(list(mix)), np.array(list(mix.values()))
        self._shares = shares / shares.sum()

    def draw(self, n: int) -> Tensor:
        """Return the abstract states of `n` fresh levels, [n, N, N, 4]."""
        states = np.empty((n, *_STATE), np.float32)
        difficulty = self._rng.choice(self._difficulties, n, p=self._shares)
        for d in np.unique(difficulty):
            rows = np.flatnonzero(difficulty == d)
            seeds = range(self.next_seed, self.next_seed + len(rows))
            self.next_seed += len(rows)
            states[rows] = abstract_states(generate_batch(int(d), seeds))
        return torch.from_numpy(states)

    def state(self) -> State:
        """Return how many levels were drawn, and the random state."""
        return State({"next_seed": self.next_seed, "rng": self._rng.bit_generator.state})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.next_seed = state.values["next_seed"]
        self._rng.bit_generator.state = state.values["rng"]


class Resumable(Protocol):
    """What goes on from a state."""

    def state(self) -> State:
        """Return all that changes."""
        ...

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""


class SequenceActor(Actor):
    """Plays actions that are drawn from a policy; delivers sequences of L = `play` + `n_step` of them."""

    def __init__(self, config: PlayConfig, network: nn.Module, generator: torch.Generator) -> None:
        """Start without a sequence.

        Args:
            config: How to play.
            network: Gets the learner's weights.
            generator: Draws actions.
        """
        self._config, self._network, self._generator = config, network.eval(), generator
        self._builder = SequenceBuilder(config.play + config.n_step, config.n_step)

    @property
    @abstractmethod
    def _parts(self) -> Mapping[str, Resumable]:
        """What is played in, by name."""

    @abstractmethod
    def _step(self) -> tuple[Mapping[str, NDArray[Any] | Tensor], Mapping[str, Sequence[float]]]:
        """Play one action in every level; return what is kept of it, [E, ...] each, and what to log."""

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Play with these weights."""
        self._network.load_state_dict(weights)

    @torch.no_grad()
    def act(self) -> Experience:
        """Play until there is a sequence; its last `n_step` actions begin the next one too."""
        steps, sequence = 0, None
        seen: dict[str, list[float]] = {}
        while sequence is None:
            tick, statistics = self._step()
            for name, values in statistics.items():
                seen.setdefault(name, []).extend(values)
            steps += self._config.environments
            sequence = self._builder.add(tick)
        return Experience(sequence, steps, {name: np.array(values) for name, values in seen.items()})

    def _choose(self, policy: Tensor) -> Tensor:
        """Draw actions by logits [E, A], int64 [E]."""
        chances = functional.softmax(policy, 1).cpu()
        return torch.multinomial(chances, 1, generator=self._generator)[:, 0]

    def state(self) -> State:
        """Return all that changes but the weights."""
        own = State(tensors={"generator": self._generator.get_state()})
        parts = {"builder": self._builder.state()} | {name: part.state() for name, part in self._parts.items()}
        return State.of({"own": own} | parts)

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._generator.set_state(state.part("own").tensors["generator"])
        self._builder.restore(state.part("builder"))
        for name, part in self._parts.items():
            part.restore(state.part(name))


class MoveActor(SequenceActor):
    """Plays instructions in the time-abstracted task."""

    def __init__(
        self,
        config: MoveConfig,
        architecture: type[LearnedPlanner],
        network: Mapping[str, Any],
        stream: int,
        *,
        device: str = "cpu",
    ) -> None:
        """Start E levels.

        Args:
            config: How to play.
            architecture: Class of the planner.
            network: Its keyword arguments.
            stream: Number of the random stream.
            device: Where planner and levels are.
        """
        self._device = torch.device(device)
        self._planner = architecture(**network).to(self._device)
        self._planner.lay_out()
        self._levels = LevelStream(difficulty_shares(config.mix), config.seed, stream)
        number = stream_number(config.seed, stream)
        generator = torch.Generator().manual_seed(number)
        failures = torch.Generator(self._device).manual_seed(number)
        self._environment = AbstractEnvironment(
            config.environments, device=device, failure_rate=config.failure_rate, generator=failures
        )
        self._environment.reset_to(torch.arange(config.environments), self._levels.draw(config.environments))
        super().__init__(config, self._planner, generator)

    @property
    def _parts(self) -> dict[str, Resumable]:
        return {"levels": self._levels, "environment": self._environment}

    def _step(self) -> tuple[dict[str, Tensor], dict[str, list[float]]]:
        state = self._environment.observe()
        with autocast(self._device):
            policy = self._planner(state).policy
        instruction = self._choose(policy).to(self._device)
        step = self._environment.step(instruction)
        over = torch.nonzero(step.solved | step.truncated)[:, 0]
        if len(over):
            self._environment.reset_to(over, self._levels.draw(len(over)))
        kept = {"state": state > 0.5, "instruction": instruction, "reward": step.reward}
        kept |= {"terminated": step.solved, "dropped": step.truncated}
        return {name: values.cpu() for name, values in kept.items()}, {"episodes/solved": step.solved[over].tolist()}
