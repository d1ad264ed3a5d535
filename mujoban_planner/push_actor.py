"""An actor that plays levels a push at a time, for methods of reinforcement learning over pushes.

Shapes: T steps, E levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import DIFFICULTIES
from mujoban_core.ranges import check_counts, check_positive
from mujoban_planner.boards import BitBoards
from mujoban_planner.push_env import PushEnvironment
from mujoban_planner.push_policy import PushPolicy
from mujoban_planner.seed_streams import stream_number
from mujoban_planner.training_levels import LevelConfig, Ticket, TrainingLevels
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.precision import autocast
from mujoban_sokoban.bitboard import SQUARES

BOARDS = BitBoards._fields
STEP = ("push", "reward", "terminated", "truncated")
"""What is delivered of a step beside the state before it."""


@dataclass(frozen=True)
class PlayConfig(LevelConfig):
    """What defines how an actor plays."""

    environments: int = 256
    """Levels at once."""
    steps: int = 8
    """Pushes in each that are delivered at once."""
    reward_scale: float = 0.1
    """Factor on rewards, so that returns are about one."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is played or learned."""
        super().__post_init__()
        check_counts(self, "environments", "steps")
        check_positive(self, "reward_scale")


class PushActor(Actor):
    """Samples pushes from a policy; a step is a push. Levels are those at which there is most to learn.

    Delivered are, [T, E] each, the state before the push (`wall`, `target`, `box`, `agent`), `push`, `reward` (scaled),
    `terminated`, `truncated` (see `PushStep`) and `log_prob`; and the states after the last pushes, `last_wall` and so
    on, [E].
    """

    def __init__(self, network: NetworkConfig, config: PlayConfig, seed: int, stream: int) -> None:
        """Start levels.

        Args:
            network: What to build for the weights that it plays with.
            config: How to play.
            seed: Of the run.
            stream: Of levels and randomness; those of another seed are others.

        Raises:
            ValueError: If the stream has no training seeds.
        """
        number = stream_number(seed, stream)
        self.policy, self.config = PushPolicy(network.build(), untaught=True).eval(), config
        self.policy.planner.lay_out()
        self._levels = TrainingLevels(number, config)
        self._generator = torch.Generator().manual_seed(number)
        self._environment = PushEnvironment(config.environments)
        self._tickets: list[Ticket] = [Ticket(0, 0, 0)] * config.environments
        self._ways: list[list[int]] = [[] for _ in range(config.environments)]
        """Pushes in each level so far, as tickets have them; only where long levels come again."""
        self._reset(np.arange(config.environments))

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Play with newer weights."""
        self.policy.load_state_dict(weights)

    @torch.no_grad()
    def act(self) -> Experience:
        """Play T pushes in every level."""
        config, environment = self.config, self._environment
        seen: dict[str, list[NDArray[Any]]] = {name: [] for name in (*BOARDS, *STEP, "log_prob")}
        statistics: dict[str, list[float]] = {f"solved/{d}": [] for d in (*DIFFICULTIES, "mined", "long")}
        statistics["moves_per_push"] = []
        for _ in range(config.steps):
            with autocast("cpu"):
                log_policy = self.policy(environment.boards).logits.log_softmax(1)
            push = torch.multinomial(log_policy.exp(), 1, generator=self._generator)
            before = {name: column.copy() for name, column in environment.boards._asdict().items()}
            step = environment.step(push[:, 0].numpy())
            if config.long:
                for way, pushed in zip(self._ways, push[:, 0].tolist(), strict=True):
                    way.append(4 * (pushed % SQUARES) + pushed // SQUARES)
            chosen = log_policy.gather(1, push)[:, 0].numpy()
            reward = step.reward * np.float32(config.reward_scale)
            values = (push[:, 0].numpy(), reward, step.terminated, step.truncated, chosen)
            for name, value in zip(seen, (*before.values(), *values), strict=True):
                seen[name].append(value)
            statistics["moves_per_push"].append(float(step.moves.mean()))
            over = np.flatnonzero(step.over)
            for row in over.tolist():
                ticket, solved = self._tickets[row], bool(step.solved[row])
                self._levels.rate(ticket, solved)
                if solved:
                    self._levels.solved_by(ticket, self._ways[row])
                statistics[f"solved/{ticket.kind}"].append(solved)
            self._reset(over)
        arrays = {name: np.stack(values) for name, values in seen.items()}
        arrays |= {f"last_{name}": column.copy() for name, column in environment.boards._asdict().items()}
        collected = {name: np.array(values, np.float32) for name, values in statistics.items()}
        return Experience(arrays, config.environments * config.steps, collected)

    def _reset(self, rows: NDArray[np.int64]) -> None:
        """Start other levels in these rows."""
        if rows.size:
            boards, tickets = self._levels.draw(len(rows))
            self._environment.reset_to(rows, boards)
            for row, ticket in zip(rows.tolist(), tickets, strict=True):
                self._tickets[row], self._ways[row] = ticket, []

    def state(self) -> State:
        """Return levels and random states."""
        values = {"tickets": [ticket.values for ticket in self._tickets], "ways": [list(way) for way in self._ways]}
        own = State(values, {"generator": self._generator.get_state()})
        return State.of({"own": own, "levels": self._levels.state(), "environment": self._environment.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._tickets = [Ticket.of(ticket) for ticket in own.values["tickets"]]
        # Runs that began before long levels came again have none, and no use for them.
        self._ways = [list(way) for way in own.values.get("ways", self._ways)]
        self._generator.set_state(own.tensors["generator"])
        self._levels.restore(state.part("levels"))
        self._environment.restore(state.part("environment"))
