"""Networks that see the privileged features of `mujoban_controller.goal_features`: teacher, values, critic.

All of them normalise what they see by the mean and deviation of the features met so far.

Shapes: D features, U actuators, M samples; `...` any leading axes, such as samples, sequences and ticks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_controller.drivers import Driver
from mujoban_controller.goal_features import feature_layout
from mujoban_controller.policy import GoalPolicy
from mujoban_core.bodies import get_body
from mujoban_rl.networks import ActionCritic, Gaussian, Normaliser

if TYPE_CHECKING:
    from mujoban_controller.goal_task import GoalTask

_LEAST_SCALE, _LARGEST_SCALE = 0.15, 1.6


def _layers(sizes: tuple[int, ...], last_gain: float) -> nn.Sequential:
    """Return fully connected layers with ELU between, orthogonal as PPO likes them."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, last_gain if i == len(sizes) - 2 else math.sqrt(2))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ELU()]
    return nn.Sequential(*layers[:-1])


class PrivilegedPolicy(GoalPolicy):
    """Policy over torques, from privileged features; the teacher of the camera policy."""

    file_name = "teacher"

    def __init__(self, body: str = "ball", width: int = 128, scale: float = 0.4) -> None:
        """Build the network.

        Args:
            body: Key in `mujoban_core.bodies.BODIES`.
            width: Of its two hidden layers.
            scale: Standard deviation of every action before training; the same in all states.
        """
        super().__init__()
        size = feature_layout(get_body(body)).size
        self.config = {"body": body, "width": width, "scale": scale}
        self.action_size = get_body(body).action_size
        self.normaliser = Normaliser(size)
        self.layers = _layers((size, width, width, self.action_size), 0.01)
        self.log_scale = nn.Parameter(torch.full((self.action_size,), math.log(scale)))

    def forward(self, features: Tensor) -> Gaussian:
        """Return the distribution over actions, [..., U], given features [..., D]."""
        mean = self.layers(self.normaliser(features))
        scale = self.log_scale.clamp(math.log(_LEAST_SCALE), math.log(_LARGEST_SCALE)).exp()
        return Gaussian(mean, scale.expand_as(mean))

    def over_windows(self, batch: Mapping[str, Tensor], skipped: int) -> Gaussian:
        """Return the distributions in the ticks of windows [M, W, ...] from number `skipped` on, [M, W - n, U]."""
        return self(batch["features"][:, skipped:])

    def normalise(self, batch: Mapping[str, Tensor]) -> None:
        """Take in the first ticks of windows [M, W, ...]."""
        self.normaliser.update(batch["features"][:, 0])

    def driver(self) -> Driver:
        """Return a driver by the mean torques."""
        return self._drive

    @torch.inference_mode()
    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the mean actions, [B, U], given features, [B, D]; in NumPy, wherever the weights are."""
        seen = torch.from_numpy(features).to(self.log_scale.device)
        return self(seen).mean.clamp(-1.0, 1.0).cpu().numpy()

    def _drive(self, task: GoalTask) -> NDArray[np.float32]:
        return self.act(task.features())


class Value(nn.Module):
    """Expected return of privileged features."""

    def __init__(self, body: str = "ball", width: int = 128) -> None:
        """Build the network for a body."""
        super().__init__()
        size = feature_layout(get_body(body)).size
        self.normaliser = Normaliser(size)
        self.layers = _layers((size, width, width, 1), 1.0)

    def forward(self, features: Tensor) -> Tensor:
        """Return V, [...], given features [..., D]."""
        return self.layers(self.normaliser(features)).squeeze(-1)


class Critic(ActionCritic):
    """Q of privileged features and actions (the asymmetric critic of paper C.3)."""

    def __init__(self, body: str = "ball", width: int = 128, extra: int = 0) -> None:
        """Build the network for a body; `extra` features stand behind the privileged ones."""
        super().__init__()
        size = feature_layout(get_body(body)).size + extra
        self.config = {"body": body, "width": width, "extra": extra}
        self.normaliser = Normaliser(size)
        self.state = nn.Linear(size, width)
        self.add_head(get_body(body).action_size, width)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return Q, [...], given features [..., D] and actions [..., U], whose leading axes broadcast."""
        return self.judge(self.state(self.normaliser(features)), action)
