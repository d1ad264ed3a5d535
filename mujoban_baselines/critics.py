"""Critics of the monolithic agent: asymmetric, on what only the simulator knows, or symmetric, on the torso (D.1).

Shape legend: N sampled actions, M windows, W ticks, K boxes, U actuators, F features of the torso, H width.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mujoban_baselines.networks import BodySense
from mujoban_core.bodies import get_body
from mujoban_core.grid import CHANNELS, GRID_SIZE, MAX_BOXES, turn_to_instruction
from mujoban_rl.networks import ActionCritic

_WIDTH = 128


class Critic(ActionCritic):
    """Q of a state and an action."""

    sees: tuple[str, ...] = ()
    """What it reads of the task beside what the agent sees."""
    teaches_torso = False
    """Whether it rests on the agent's torso, which then learns from its loss alone."""

    @property
    def sense(self) -> BodySense | None:
        """What reads proprioception, if it does."""
        return None

    def __init__(self, body: str, width: int = _WIDTH) -> None:
        """Build what follows the encoding of the state, which has H = `width` features."""
        super().__init__()
        self.add_head(get_body(body).action_size, width)

    @abstractmethod
    def state(self, batch: Mapping[str, Tensor], features: Tensor) -> Tensor:
        """Return the encoding of states, [M, W, H].

        Args:
            batch: Windows, [M, W, ...] each.
            features: Of the agent's torso, [M, W, F].
        """

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return Q, [...], of encoded states [..., H] and actions [..., U], whose leading axes broadcast."""
        return self.judge(state, action)


class SymmetricCritic(Critic):
    """Sees what the agent sees: a head on its torso."""

    teaches_torso = True

    def __init__(self, body: str, features: int, width: int = _WIDTH) -> None:
        """Attach to a torso of F = `features`."""
        super().__init__(body, width)
        self.torso = nn.Linear(features, width)

    def state(self, batch: Mapping[str, Tensor], features: Tensor) -> Tensor:
        """Return the encoding of states, [M, W, H]; gradients reach the torso."""
        return self.torso(features)


class AsymmetricCritic(Critic):
    """Sees s_abst, o_pos and o_box, and feels what the robot feels."""

    sees = ("abstract_state", "box_position", "pose", "proprio")

    def __init__(self, body: str, width: int = _WIDTH) -> None:
        """Build the network."""
        super().__init__(body, width)
        self._extent = 0.5 * GRID_SIZE * get_body(body).cell_size
        self.body_sense = BodySense(body, pose=True)
        edge = GRID_SIZE // 2
        self.map = nn.Sequential(
            nn.Conv2d(len(CHANNELS), 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 32, 3, 2, 1), nn.ReLU(), nn.Flatten(),
            nn.Linear(32 * edge * edge, width), nn.ReLU(),
        )  # fmt: skip
        self.poses = nn.Sequential(nn.Linear(self.body_sense.size + 5 * MAX_BOXES, width), nn.ReLU())
        self.mix = nn.Linear(2 * width, width)

    @property
    def sense(self) -> BodySense:
        """What reads proprioception."""
        return self.body_sense

    def state(self, batch: Mapping[str, Tensor], features: Tensor) -> Tensor:
        """Return the encoding of states, [M, W, H]."""
        flat = {name: batch[name].flatten(0, 1) for name in self.sees}
        abstract = flat["abstract_state"].to(features.dtype).permute(0, 3, 1, 2)
        felt = self.sense(flat["proprio"], flat["pose"])
        known = torch.cat([self.map(abstract), self.poses(torch.cat([felt, self._boxes(flat)], -1))], -1)
        return self.mix(known).view(*batch["pose"].shape[:2], -1)

    def _boxes(self, flat: Mapping[str, Tensor]) -> Tensor:
        """Return where boxes are: on the map, as seen by the robot, and whether there are so many, [M, 5 K]."""
        position, pose = flat["box_position"], flat["pose"]
        present = (position.abs() < 2.0 * self._extent).all(-1, keepdim=True).to(position.dtype)
        offset = position - pose[:, None, :2]
        cos, sin = pose[:, 2:].cos(), pose[:, 2:].sin()
        ahead, left = turn_to_instruction(offset[..., 0], offset[..., 1], cos, sin)
        parts = [position / self._extent, torch.stack([ahead, left], -1) / self._extent]
        return torch.cat([*(part * present for part in parts), present], -1).flatten(1)
