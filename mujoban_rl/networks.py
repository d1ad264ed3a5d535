"""Parts of the networks that see frames or drive motors, which more than one package builds with.

Shape legend: B robots, M samples, D features, U actuators, F features of a frame; `...` any leading axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.camera import FRAME_SIZE, CameraMount, project
from mujoban_rl.precision import autocast

MIN_SCALE: Final = 1e-3
"""Smallest standard deviation of a torque."""
INITIAL_SCALE: Final = 0.5
"""Standard deviation of every torque before training."""
_CLIP: Final = 5.0
_NARROWEST: Final = 8
"""Channels of an encoder at least."""


class Gaussian(NamedTuple):
    """A diagonal normal distribution over torques."""

    mean: Tensor
    scale: Tensor

    def sample(self, generator: torch.Generator | None = None) -> Tensor:
        """Return one draw, not limited to [-1, 1]."""
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.at(noise)

    def at(self, noise: Tensor) -> Tensor:
        """Return the torques that lie so many standard deviations from the mean, not limited to [-1, 1]."""
        return self.mean + self.scale * noise

    def limited_log_prob(self, action: Tensor) -> Tensor:
        """Return the log-probability of torques [..., U] as the world takes them, limited to [-1, 1], [...].

        All torques beyond a limit are one to the world, and have the probability of the whole tail. By the density of
        what was drawn, noise alone would teach a mean that has passed a limit, and drive it away for good (Fujita and
        Maeda 2018).
        """
        normal = torch.distributions.Normal(self.mean, self.scale, validate_args=False)
        beyond = torch.special.log_ndtr((self.mean * action.sign() - 1.0) / self.scale)
        return torch.where(action.abs() < 1.0, normal.log_prob(action), beyond).sum(-1)


def encode_frames(encoder: nn.Module, frame: Tensor, dtype: torch.dtype, *, mixed_precision: bool) -> Tensor:
    """Return the features [M, F] that a ResNet finds in frames uint8 [M, rows, columns, 3].

    Args:
        encoder: The ResNet.
        frame: Pictures.
        dtype: Of the features.
        mixed_precision: Whether the ResNet computes in bfloat16, where that pays.
    """
    # A permuted NHWC tensor is channels_last already.
    x = (frame.permute(0, 3, 1, 2).to(dtype) / 255.0).sub_(0.5)
    with autocast(frame.device, enabled=mixed_precision):
        return encoder(x).to(dtype)


def gaussian_layers(features: int, actions: int) -> tuple[nn.Linear, nn.Linear]:
    """Return the layers for mean and scale, which begin close to zero and to `INITIAL_SCALE`."""
    layers = nn.Linear(features, actions), nn.Linear(features, actions)
    for layer in layers:
        nn.init.uniform_(layer.weight, -1e-3, 1e-3)
        nn.init.zeros_(layer.bias)
    return layers


def gaussian(mean: Tensor, raw_scale: Tensor) -> Gaussian:
    """Return the distribution given the outputs of `gaussian_layers`, [..., U] each."""
    scale = INITIAL_SCALE * functional.softplus(raw_scale + math.log(math.expm1(1.0)))
    return Gaussian(mean, scale + MIN_SCALE)


@torch.no_grad()
def set_scale(layer: nn.Linear, scale: float) -> None:
    """Let a layer for the scale, of `gaussian_layers`, answer `scale` for all features.

    Raises:
        ValueError: If the scale is not above `MIN_SCALE`.
    """
    if scale <= MIN_SCALE:
        raise ValueError(f"scale {scale}: expected more than {MIN_SCALE}")
    nn.init.zeros_(layer.weight)
    nn.init.constant_(layer.bias, math.log(math.expm1((scale - MIN_SCALE) / INITIAL_SCALE)) - math.log(math.expm1(1.0)))


class Normaliser(nn.Module):
    """Scales features to mean 0 and deviation 1 of the samples that `update` has seen."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        """Begin as the identity."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, features: Tensor) -> None:
        """Take in samples, [M, D]."""
        x = features.double()
        total = self.count + len(x)
        delta = x.mean(0) - self.mean
        spread = self.variance * self.count + x.var(0, unbiased=False) * len(x)
        spread = spread + delta.square() * self.count * len(x) / total
        self.mean.add_((delta * len(x) / total).float())
        self.variance.copy_(spread / total)
        self.count.copy_(total)

    def forward(self, features: Tensor) -> Tensor:
        """Return normalised features, [..., D]."""
        return ((features - self.mean) / (self.variance + 1e-4).sqrt()).clamp(-_CLIP, _CLIP)


class ActionCritic(nn.Module):
    """What critics of torques have in common: Q of a state, which is encoded once for all actions weighed in it."""

    action: nn.Linear
    norm: nn.LayerNorm
    hidden: nn.Linear
    value: nn.Linear

    def add_head(self, actions: int, width: int) -> None:
        """Make what follows the encoding of states, [..., H = `width`], for U = `actions`.

        Checkpoints and draws of weights know layers by their order: what is made before this comes first.
        """
        self.action = nn.Linear(actions, width, bias=False)
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, width)
        self.value = nn.Linear(width, 1)

    def judge(self, state: Tensor, action: Tensor) -> Tensor:
        """Return Q, [...], of encoded states [..., H] and actions [..., U], whose leading axes broadcast."""
        x = torch.tanh(self.norm(state + self.action(action.clamp(-1.0, 1.0))))
        return self.value(functional.elu(self.hidden(x))).squeeze(-1)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside a strided 1x1 one (He et al. 2016), without normalisation."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.shortcut = nn.Conv2d(inputs, outputs, 1, stride)
        with torch.no_grad():
            self.second.weight.mul_(0.5)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to [B, C', H / stride, W / stride]."""
        y = self.second(functional.relu(self.first(x), inplace=True))
        return functional.relu(y.add_(self.shortcut(x)), inplace=True)


class PreActivatedBlock(nn.Module):
    """Two 3x3 convolutions, each after a ReLU, beside the identity (He et al. 2016b, Espeholt et al. 2018)."""

    def __init__(self, channels: int, gain: float = 1.0) -> None:
        """Begin with the second convolution's weights times `gain`."""
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(gain)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to the same."""
        y = self.second(functional.relu(self.first(functional.relu(x)), inplace=True))
        return y.add_(x)  # in place, as no gradient needs what was there before


def frame_encoder(channels: Sequence[int], features: int, rows: int) -> nn.Sequential:
    """Return the ResNet from frames [B, 3, rows, 64] to features [B, F]; the last block keeps its resolution.

    Raises:
        ValueError: If there are fewer than two widths, or one is below 8: in the gradient of a strided 1x1 convolution
            of fewer channels, oneDNN writes beyond its memory on processors with AVX2 but not AVX-512 (PyTorch 2.13).
    """
    if len(channels) < 2 or min(channels) < _NARROWEST:
        raise ValueError(
            f"channels {' '.join(map(str, channels))}: expected the stem's width and one for each residual block, "
            f"each at least {_NARROWEST}"
        )
    stem, *widths = channels
    layers: list[nn.Module] = [nn.Conv2d(3, stem, 4, 2, 1), nn.ReLU(inplace=True)]
    shrink, width = 2, stem
    for i, outputs in enumerate(widths):
        stride = 1 if i == len(widths) - 1 else 2
        layers.append(ResidualBlock(width, outputs, stride))
        shrink, width = shrink * stride, outputs
    flat = width * (rows // shrink) * (FRAME_SIZE // shrink)
    layers += [nn.Flatten(), nn.Linear(flat, features), nn.LayerNorm(features), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


def rows_of_sky(mount: CameraMount, multiple: int) -> int:
    """Return how many rows at the top of a frame can be left out: those above the horizon, rounded down.

    Heading, which the skyline shows, is in proprioception; the rest of what matters is on the floor.
    """
    level = project([[1e6, 0.0, mount.height]], np.zeros(3), mount).pixels[0, 1]
    return max(int(level) // multiple * multiple, 0)
