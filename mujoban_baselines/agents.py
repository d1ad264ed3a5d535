"""The agents of the paper's appendix D.

Shape legend: M samples, F features.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_baselines.drawing import Drawing
from mujoban_baselines.networks import BodySense, Recurrent, RecurrentAgent, Sights, dense, view_encoder
from mujoban_baselines.repeat import Repeating
from mujoban_baselines.subgoals import Subgoals
from mujoban_controller.controller import FEATURES, HIDDEN, WIDTHS
from mujoban_core.agent import Agent, AgentInput
from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_core.interfaces import Memory
from mujoban_rl.exploration import Exploration
from mujoban_rl.networks import frame_encoder, rows_of_sky


class Size(NamedTuple):
    """Widths of a variant of the monolithic agent."""

    channels: tuple[int, ...]
    """Of the ResNet's stem and blocks."""
    features: int
    """Of fully connected layers."""
    hidden: int
    """Of the LSTM."""
    extra: int
    """Further layers for what is not seen, and behind the LSTM."""


SIZES: Final = {
    "S": Size(WIDTHS, FEATURES, HIDDEN, 0),
    "M": Size(WIDTHS, 512, 384, 0),
    "L": Size(WIDTHS, 512, 384, 2),
}
"""Small is the controller without instructions; medium widens LSTM and layers; large adds layers (paper D.1)."""


class MonolithicAgent(RecurrentAgent):
    """Monolithic RL (paper D.1): ResNet and LSTM on o_cam, o_pr and o_pos."""

    sees = ("frame", "proprio", "pose")

    def __init__(
        self, body: str = "ball", size: str = "S", repeat: int = 1, draws: Exploration | None = None
    ) -> None:
        """Build a variant of the network.

        Args:
            body: Key in `mujoban_core.bodies.BODIES`.
            size: Key of `SIZES`.
            repeat: Ticks for which its torques are to be held.
            draws: Noise by which they are to be drawn in play; None: their means are played.

        Raises:
            ValueError: If body, size or noise are unknown, or torques held for no tick.
        """
        if size not in SIZES:
            raise ValueError(f"size {size!r}: expected one of {', '.join(SIZES)}")
        chosen = SIZES[size]
        super().__init__(body, chosen.features, chosen.hidden, [chosen.features] * (1 + chosen.extra))
        self.config["size"] = size
        self.play_by(repeat, draws)
        # What lies above the horizon shows the heading, which is in o_pos.
        self.first_row = rows_of_sky(get_body(body).camera, 2 ** (len(chosen.channels) - 1))
        self.encoder = frame_encoder(chosen.channels, chosen.features, FRAME_SIZE - self.first_row)
        self.body_sense = BodySense(body, pose=True)
        self.body_encoder = dense(self.body_sense.size, *[chosen.features] * (1 + chosen.extra))
        self.mix = dense(2 * chosen.features, chosen.features)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def sense(self) -> BodySense:
        """What reads proprioception."""
        return self.body_sense

    def embed(self, sights: Mapping[str, Tensor]) -> Tensor:
        """Return the encoding of what is seen, [M, F]."""
        seen = self.encode(self.encoder, sights["frame"][:, self.first_row :])
        felt = self.body_encoder(self.body_sense(sights["proprio"], sights["pose"]))
        return self.mix(torch.cat([seen, felt], -1))


_VIEW, _FELT, _HIDDEN = 256, 100, 192


class TopDownAgent(RecurrentAgent):
    """Fully observable monolithic RL (paper D.2): o_top and o_pr; privileged."""

    sees: tuple[str, ...] = ("top_down", "proprio")

    def __init__(
        self, body: str = "ball", repeat: int = 1, draws: Exploration | None = None, *, embedded: int = _VIEW + _FELT
    ) -> None:
        """Build the network.

        Args:
            body: Key in `mujoban_core.bodies.BODIES`.
            repeat: Ticks for which its torques are to be held.
            draws: Noise by which they are to be drawn in play; None: their means are played.
            embedded: Features of everything that is seen.

        Raises:
            ValueError: If body or noise are unknown, or torques held for no tick.
        """
        super().__init__(body, embedded, _HIDDEN, [_VIEW])
        self.play_by(repeat, draws)
        self.encoder = view_encoder(_VIEW)
        self.body_sense = BodySense(body, pose=False)
        self.body_encoder = dense(self.body_sense.size, _FELT)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def sense(self) -> BodySense:
        """What reads proprioception."""
        return self.body_sense

    def embed(self, sights: Mapping[str, Tensor]) -> Tensor:
        """Return the encoding of what is seen, [M, embedded]."""
        seen = self.encode(self.encoder, sights["top_down"])
        return torch.cat([seen, self.body_encoder(self.body_sense(sights["proprio"]))], -1)


class StructuredAgent(TopDownAgent):
    """Fully observable structured RL (paper D.2): sees s_abst as well, and an adjacent state that it is to reach.

    Its subgoals are its own: it draws them at random wherever it plays, and they are part of its memory.
    """

    sees = ("top_down", "proprio", "abstract_state")

    def __init__(self, body: str = "ball", repeat: int = 1, draws: Exploration | None = None) -> None:
        """Build the network; arguments and errors are those of `TopDownAgent`."""
        super().__init__(body, repeat, draws, embedded=2 * _VIEW + _FELT)
        cells = GRID_SIZE * GRID_SIZE
        self.map_encoder = nn.Sequential(
            nn.Conv2d(2 * len(CHANNELS), 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 16, 3, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(16 * cells, _VIEW), nn.ReLU(),
        )  # fmt: skip

    @property
    def reads(self) -> tuple[str, ...]:
        """What is seen, and the state to reach."""
        return (*self.sees, "subgoal")

    def embed(self, sights: Mapping[str, Tensor]) -> Tensor:
        """Return the encoding of what is seen, [M, embedded]."""
        maps = torch.cat([sights["abstract_state"], sights["subgoal"]], -1).to(self.mean.weight.dtype)
        return torch.cat([super().embed(sights), self.map_encoder(maps.permute(0, 3, 1, 2))], -1)

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return an empty memory without subgoals."""
        return (*self.initial_memory(len(seeds)), *Subgoals.none_yet(seeds))

    def look(self, inputs: AgentInput, state: Memory) -> tuple[Sights, Recurrent, Memory]:
        """Return what the network reads in this tick, with the subgoals in force, and the subgoals after it."""
        assert inputs.abstract_state is not None
        sights, memory, others = super().look(inputs, state)
        subgoals = Subgoals(*others).renewed(inputs.abstract_state)
        seen = {**sights, "abstract_state": inputs.abstract_state > 0.5, "subgoal": subgoals.target}
        return seen, memory, tuple(subgoals.aged(self.repeat))


AGENTS: Final[dict[str, Any]] = {cls.__name__: cls for cls in (MonolithicAgent, TopDownAgent, StructuredAgent)}
"""The agents that weights may be of, by the class that their record names."""


def playing(agent: RecurrentAgent) -> Agent:
    """Return what plays as an agent is to be played: by means or draws, in every tick or held."""
    played = agent if agent.draws is None else Drawing(agent, agent.draws)
    return played if agent.repeat == 1 else Repeating(played, agent.repeat, agent.action_size)


def untrained() -> Agent:
    """Return the floor of Table 1: what its monolithic agents of size S for the ball do before they learn.

    Their means are close to 0, so that it plays the noise by which they explore. The same weights each time.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return playing(MonolithicAgent(repeat=4, draws="pink").eval())
