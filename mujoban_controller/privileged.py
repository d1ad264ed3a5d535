"""Networks that see the privileged features of `mujoban_controller.goal_features`: the critic and a teacher.

Shapes: D features, U actuators; `...` any leading axes, such as samples, sequences and ticks.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.controller import Gaussian, gaussian, gaussian_layers
from mujoban_controller.goal_features import feature_size
from mujoban_core.bodies import get_body


class PrivilegedPolicy(nn.Module):
    """Policy over torques from privileged features; the teacher that MPO trains on small machines."""

    def __init__(self, body: str = "ball", width: int = 256) -> None:
        """Build the network for a body."""
        super().__init__()
        self.config = {"body": body, "width": width}
        layout = get_body(body)
        self.trunk = nn.Sequential(
            nn.Linear(feature_size(layout.proprio_size), width), nn.LayerNorm(width), nn.Tanh(),
            nn.Linear(width, width), nn.ELU(),
        )  # fmt: skip
        self.action_size = layout.action_size
        self.mean, self.scale = gaussian_layers(width, layout.action_size)

    def forward(self, state: Tensor) -> Gaussian:
        """Return the distribution over torques, [..., U], given features [..., D]."""
        x = self.trunk(state)
        return gaussian(self.mean(x), self.scale(x))


class Critic(nn.Module):
    """Q of privileged features and torques (the asymmetric critic of paper C.3)."""

    def __init__(self, body: str = "ball", width: int = 256) -> None:
        """Build the network for a body."""
        super().__init__()
        layout = get_body(body)
        self.state = nn.Linear(feature_size(layout.proprio_size), width)
        self.action = nn.Linear(layout.action_size, width, bias=False)
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, width)
        self.value = nn.Linear(width, 1)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return Q, [...], given features [..., D] and torques [..., U], whose leading axes broadcast."""
        x = torch.tanh(self.norm(self.state(state) + self.action(action.clamp(-1.0, 1.0))))
        return self.value(functional.elu(self.hidden(x))).squeeze(-1)
