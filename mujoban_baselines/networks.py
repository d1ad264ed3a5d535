"""What the agents' networks are built of: senses of the body, the ResNet over views from above, a recurrent policy.

Shape legend: B robots, T ticks, M samples, P proprioceptive values, U actuators, F features, H memory units.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_core.agent import Agent, AgentInput
from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import GRID_SIZE
from mujoban_core.interfaces import Memory
from mujoban_core.ranges import check_counts
from mujoban_rl.exploration import Exploration, check_exploration
from mujoban_rl.networks import Gaussian, Normaliser, PreActivatedBlock, encode_frames, gaussian, gaussian_layers

Sights = Mapping[str, NDArray[Any]]
"""What an agent sees and its networks read, by name, [B, ...] each."""


class BodySense(nn.Module):
    """What the robot feels, and where it is, as numbers of about one."""

    def __init__(self, body: str, *, pose: bool) -> None:
        """Read o_pr of a body, and o_pos if `pose`."""
        super().__init__()
        layout = get_body(body)
        self._angle = layout.proprio.joint_position
        self._extent = 0.5 * GRID_SIZE * layout.cell_size
        self.normaliser = Normaliser(layout.proprio_size)
        # Positions of hinges, which may turn freely, are replaced by sine and cosine.
        self.size = layout.proprio_size + len(layout.joints) + 4 * pose
        rest = np.ones(layout.proprio_size, np.bool_)
        rest[self._angle] = False
        self._rest = torch.from_numpy(np.flatnonzero(rest))

    def meet(self, proprio: Tensor, updates: int) -> bool:
        """Normalise also by o_pr, [M, P], in the first updates, each with as many; return whether it was one of these.

        One that has been normalised before, as that of a clone, stays as it is.
        """
        first = int(self.normaliser.count) < updates * len(proprio)
        if first:
            self.normaliser.update(proprio)
        return first

    def forward(self, proprio: Tensor, pose: Tensor | None = None) -> Tensor:
        """Return what is felt, [M, size], of o_pr [M, P] and o_pos [M, 3]."""
        angle = proprio[:, self._angle]
        parts = [self.normaliser(proprio)[:, self._rest], angle.cos(), angle.sin()]
        if pose is not None:
            parts += [pose[:, :2] / self._extent, pose[:, 2:].cos(), pose[:, 2:].sin()]
        return torch.cat(parts, -1)


def view_encoder(features: int, channels: Sequence[int] = (16, 32, 32), blocks: int = 2) -> nn.Sequential:
    """Return the ResNet of paper D.2 from views [M, 3, 64, 64] to features [M, F]: a stage halves the resolution."""
    layers: list[nn.Module] = []
    width, edge = 3, FRAME_SIZE
    for outputs in channels:
        layers += [nn.Conv2d(width, outputs, 3, padding=1), nn.MaxPool2d(3, 2, 1)]
        layers += [PreActivatedBlock(outputs, gain=0.5) for _ in range(blocks)]
        width, edge = outputs, edge // 2
    layers += [nn.ReLU(inplace=True), nn.Flatten(), nn.Linear(width * edge * edge, features), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def dense(inputs: int, *widths: int) -> nn.Sequential:
    """Return fully connected layers, each with a ReLU behind."""
    sizes = (inputs, *widths)
    layers = [(nn.Linear(a, b), nn.ReLU()) for a, b in zip(sizes, widths, strict=False)]
    return nn.Sequential(*(layer for pair in layers for layer in pair))


class Recurrent(NamedTuple):
    """The LSTM's memory."""

    output: Tensor
    """[B, H]."""
    cell: Tensor
    """[B, H]."""


class AgentOutput(NamedTuple):
    """Result of `RecurrentAgent.forward`."""

    action: Gaussian
    """Distribution over torques; mean and scale [B, T, U]."""
    features: Tensor
    """What it rests on, [B, T, F]; values and critics that share the torso attach here."""
    memory: Recurrent
    """After the last tick."""


class RecurrentAgent(nn.Module, Agent):
    """An encoder of what is seen, an LSTM, and a normal distribution over torques.

    As an `Agent` it is deterministic: the mean torque, limited to [-1, 1]. Subclasses build the encoder.
    """

    repeat: int = 1
    """Ticks for which whoever plays holds a torque; the ticks of this class are those in which it is asked."""
    draws: Exploration | None = None
    """Noise by which whoever plays draws the torques; None: he takes their means."""

    def __init__(self, body: str, embedded: int, hidden: int, trunk: Sequence[int]) -> None:
        """Build what follows the encoder.

        Args:
            body: Key in `mujoban_core.bodies.BODIES`; fixes P and U.
            embedded: Features that `embed` returns.
            hidden: H, width of the LSTM.
            trunk: Widths of the layers between LSTM and distribution.
        """
        super().__init__()
        self.config: dict[str, Any] = {"body": body}
        self.mixed_precision = False
        """Whether convolutions may compute in bfloat16: in training, not on the robot, so that runs repeat exactly."""
        layout = get_body(body)
        self.proprio_size, self.action_size = layout.proprio_size, layout.action_size
        self.hidden, self.width = hidden, trunk[-1]
        self.lstm = nn.LSTMCell(embedded, hidden)
        self.trunk = dense(hidden + embedded, *trunk)
        self.mean, self.scale = gaussian_layers(self.width, self.action_size)

    def play_by(self, repeat: int, draws: Exploration | None) -> None:
        """Say how whoever plays is to hold and draw torques; weights remember it, if the class takes both by name.

        Args:
            repeat: Ticks for which a torque is held.
            draws: Noise by which torques are drawn; None: their means are played.

        Raises:
            ValueError: If torques are held for no tick, or there is no such noise.
        """
        self.repeat, self.draws = repeat, draws
        check_counts(self, "repeat")
        self.config["repeat"] = repeat
        if draws is not None:
            check_exploration(draws)
            self.config["draws"] = draws

    @property
    def reads(self) -> tuple[str, ...]:
        """What `forward` reads: what is seen, and what `look` adds to it."""
        return self.sees

    @property
    @abstractmethod
    def sense(self) -> BodySense | None:
        """What reads proprioception, normalised by what training meets first; None if the agent does not see it."""

    @abstractmethod
    def embed(self, sights: Mapping[str, Tensor]) -> Tensor:
        """Return the encoding of what is seen, [M, embedded], of sights [M, ...]."""

    def encode(self, encoder: nn.Module, frame: Tensor) -> Tensor:
        """Return the features [M, F] that a ResNet finds in frames uint8 [M, rows, columns, 3]."""
        return encode_frames(encoder, frame, self.mean.weight.dtype, mixed_precision=self.mixed_precision)

    def forward(
        self, sights: Mapping[str, Tensor], memory: Recurrent, first: Tensor | None = None
    ) -> AgentOutput:
        """Run the policy over sequences.

        Args:
            sights: What is seen, [B, T, ...] each.
            memory: Before the first tick.
            first: Ticks before which an episode begins and the memory is cleared, bool [B, T].
        """
        b, t = next(iter(sights.values())).shape[:2]
        embedded = self.embed({name: values.flatten(0, 1) for name, values in sights.items()}).view(b, t, -1)
        keep = None if first is None else (~first[..., None]).to(embedded.dtype)
        h, c = memory
        outputs = []
        for i in range(t):
            if keep is not None:
                h, c = h * keep[:, i], c * keep[:, i]
            h, c = self.lstm(embedded[:, i], (h, c))
            outputs.append(h)
        features = self.trunk(torch.cat([torch.stack(outputs, 1), embedded], -1))
        return AgentOutput(self.distribution(features), features, Recurrent(h, c))

    def distribution(self, features: Tensor) -> Gaussian:
        """Return the distribution over torques, mean and scale [..., U], that rests on features [..., F]."""
        return gaussian(self.mean(features), self.scale(features))

    def initial_memory(self, batch: int) -> Memory:
        """Return zeros, a `Recurrent`."""
        device = self.mean.weight.device
        return Recurrent(*(torch.zeros(batch, self.hidden, device=device) for _ in range(2)))

    def look(self, inputs: AgentInput, state: Memory) -> tuple[Sights, Recurrent, Memory]:
        """Return what the network reads in this tick, the LSTM's memory, and what else is remembered."""
        sights = {name: getattr(inputs, name) for name in self.sees}
        return sights, Recurrent(*state[:2]), tuple(state[2:])

    def to_tensors(self, sights: Sights) -> dict[str, Tensor]:
        """Return one tick's sights, [B, ...], as sequences of one tick, [B, 1, ...], on the module's device."""
        device = self.mean.weight.device
        return {k: torch.from_numpy(np.ascontiguousarray(v)).to(device).unsqueeze(1) for k, v in sights.items()}

    @torch.inference_mode()
    def respond(self, inputs: AgentInput, state: Memory) -> tuple[Gaussian, Memory]:
        """Return the distribution over the torques of this tick, mean and scale [B, U], and the next state."""
        sights, memory, others = self.look(inputs, state)
        output = self.forward(self.to_tensors(sights), memory)
        return Gaussian(*(part[:, 0] for part in output.action)), (*output.memory, *others)

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the mean torque limited to [-1, 1], [B, U], and the next state."""
        torque, state = self.respond(inputs, state)
        return torque.mean.clamp(-1.0, 1.0).cpu().numpy(), state
