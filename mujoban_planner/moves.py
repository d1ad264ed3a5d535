"""Who plays for MPO over moves: an actor in hundreds of levels of the time-abstracted task at once.

Shapes: E levels, L instructions of a sequence, N = `grid.GRID_SIZE`, A = 5 instructions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_planner.abstract_env import AbstractEnvironment, AbstractStep
from mujoban_planner.boards import abstract_states
from mujoban_planner.discrete_mpo import MPOSettings
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.validation import Shares, difficulty_shares
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.replay import SequenceBuilder
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

_STATE: Final = (GRID_SIZE, GRID_SIZE, len(CHANNELS))
_FIRST_STREAM: Final = 600_000
_STREAMS_PER_SEED: Final = 1000
_SEEDS_PER_STREAM: Final = 10**12


@dataclass(frozen=True)
class PlayConfig(MPOSettings):
    """What defines how an actor plays, and how is learned from it."""

    failure_rate: float = 0.0
    """Probability that an instruction fails, as with a real controller."""
    mix: Shares = (0.1, 0.1, 0.15, 0.2, 0.45)
    """Share of each difficulty among the training levels."""


class LevelStream:
    """Fresh training levels, one after the other."""

    def __init__(self, mix: dict[int, float], seed: int, stream: int = 0) -> None:
        """Draw difficulties by `mix`; `seed` and `stream` choose difficulties and levels.

        Raises:
            ValueError: If the stream has no training seeds.
        """
        number = _FIRST_STREAM + _STREAMS_PER_SEED * seed + stream
        self.next_seed = TRAIN_SEEDS.start + number * _SEEDS_PER_STREAM
        if seed < 0 or not 0 <= stream < _STREAMS_PER_SEED or self.next_seed not in TRAIN_SEEDS:
            raise ValueError(f"stream {stream} of seed {seed}: expected 0 to {_STREAMS_PER_SEED - 1} of a small seed")
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


class MoveActor(Actor):
    """Plays instructions that are drawn from the policy; delivers sequences of L = `play` + `n_step` of them."""

    def __init__(
        self,
        config: PlayConfig,
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
        self._config, self._device = config, torch.device(device)
        self._planner = architecture(**network).to(self._device).eval()
        self._planner.lay_out()
        self._levels = LevelStream(difficulty_shares(config.mix), config.seed, stream)
        self._generator = torch.Generator().manual_seed(_STREAMS_PER_SEED * config.seed + stream)
        failures = torch.Generator(self._device).manual_seed(_STREAMS_PER_SEED * config.seed + stream)
        self._environment = AbstractEnvironment(
            config.environments, device=device, failure_rate=config.failure_rate, generator=failures
        )
        self._environment.reset_to(torch.arange(config.environments), self._levels.draw(config.environments))
        self._builder = SequenceBuilder(config.play + config.n_step, config.n_step)

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Play with these weights."""
        self._planner.load_state_dict(weights)

    def act(self) -> Experience:
        """Play until there is a sequence; its last `n_step` instructions begin the next one too."""
        steps, sequence = 0, None
        solved: list[bool] = []
        while sequence is None:
            tick, outcome = self._step()
            over = outcome.solved | outcome.truncated
            solved += outcome.solved[over].tolist()
            steps += self._config.environments
            sequence = self._builder.add({name: values.cpu() for name, values in tick.items()})
        return Experience(sequence, steps, {"episodes/solved": np.array(solved)})

    @torch.no_grad()
    def _step(self) -> tuple[dict[str, Tensor], AbstractStep]:
        """Play one instruction in every level; return what is kept of it, [E, ...] each, and what happened."""
        state = self._environment.observe()
        with torch.autocast(self._device.type, torch.bfloat16):
            policy = self._planner(state).policy
        chances = functional.softmax(policy, 1).cpu()
        instruction = torch.multinomial(chances, 1, generator=self._generator)[:, 0].to(self._device)
        step = self._environment.step(instruction)
        over = torch.nonzero(step.solved | step.truncated)[:, 0]
        if len(over):
            self._environment.reset_to(over, self._levels.draw(len(over)))
        kept = {"state": state > 0.5, "instruction": instruction, "reward": step.reward}
        return {**kept, "terminated": step.solved, "dropped": step.truncated}, step

    def state(self) -> State:
        """Return all that changes but the weights."""
        own = State(tensors={"generator": self._generator.get_state()})
        parts = {"levels": self._levels, "environment": self._environment, "builder": self._builder}
        return State.of({"own": own} | {name: part.state() for name, part in parts.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._generator.set_state(state.part("own").tensors["generator"])
        self._levels.restore(state.part("levels"))
        self._environment.restore(state.part("environment"))
        self._builder.restore(state.part("builder"))
