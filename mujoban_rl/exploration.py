"""Noise by which actors explore with a continuous policy.

Shapes: K parts of the noise, B robots, U actuators.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_rl.engine import State

Exploration = Literal["pink", "white"]
"""How alike successive draws are."""
FADES: Final[dict[Exploration, tuple[float, ...]]] = {"pink": (2.0, 8.0, 32.0, 128.0), "white": (0.0,)}
"""Ticks in which the parts of a noise fade, each to 1/e."""


def check_exploration(kind: str) -> None:
    """Raise a ValueError unless there is noise of that kind."""
    if kind not in FADES:
        raise ValueError(f"exploration {kind!r}: expected one of {', '.join(FADES)}")


def kept(kind: Exploration, ticks: int) -> Tensor:
    """Return the share of each part that is left after so many ticks, [K].

    Raises:
        ValueError: If there is no such kind.
    """
    check_exploration(kind)
    return torch.tensor([np.exp(-ticks / t) if t > 0 else 0.0 for t in FADES[kind]]).float()


def fade(parts: Tensor, fresh: Tensor, keeps: Tensor) -> Tensor:
    """Return the next parts, [..., K, U], of those before and standard normal ones, of which `keeps` [K] are left."""
    keeps = keeps[:, None]
    return keeps * parts + (1.0 - keeps.square()).sqrt() * fresh


def mix(parts: Tensor) -> Tensor:
    """Return the noise that parts [..., K, U] make up, [..., U]."""
    return parts.sum(-2) / parts.shape[-2] ** 0.5


class Noise:
    """Standard normal noise for each motor of B robots, white or pink.

    Each draw alone is standard normal, so that torques have the policy's distribution; how alike successive draws are
    is another matter. White noise shakes a robot that has a mass, and leaves it where it is. Of pink noise (power 1/f;
    for MPO: Eberhard et al. 2023) the slow part drives it about and the fast one varies its ways. It is a sum of K
    Ornstein-Uhlenbeck processes of equal variance, whose times lie evenly on a logarithmic scale.
    """

    def __init__(
        self, kind: Exploration, robots: int, actuators: int, generator: torch.Generator, *, ticks: int = 1
    ) -> None:
        """Begin with every part in its stationary distribution.

        Args:
            kind: Key of `FADES`.
            robots: B.
            actuators: U.
            generator: CPU source of all draws.
            ticks: From one draw to the next.

        Raises:
            ValueError: If there is no such kind.
        """
        self._generator, self._keeps = generator, kept(kind, ticks)
        self._parts = self._normal(robots, actuators)

    def _normal(self, robots: int, actuators: int) -> Tensor:
        return torch.randn(robots, len(self._keeps), actuators, generator=self._generator)

    def draw(self) -> Tensor:
        """Return the next noise, [B, U]."""
        robots, _, actuators = self._parts.shape
        self._parts = fade(self._parts, self._normal(robots, actuators), self._keeps)
        return mix(self._parts)

    def renew(self, rows: NDArray[Any]) -> None:
        """Begin anew for some robots, whose episodes begin: rows int [M]."""
        self._parts[torch.from_numpy(rows)] = self._normal(len(rows), self._parts.shape[2])

    def state(self) -> State:
        """Return what changes, but the generator."""
        return State({}, {"parts": self._parts})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._parts = state.tensors["parts"].clone()
