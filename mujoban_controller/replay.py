"""A ring of sequences with the recurrent state at their starts (Kapturowski et al. 2019).

Shapes: C sequences in the ring, B robots, T ticks, M sequences in a batch.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.interfaces import Memory


def memory_fields(memory: Memory) -> dict[str, NDArray]:
    """Return a memory's arrays by name, copied, as per-sequence fields."""
    return {f"memory{i}": torch.as_tensor(m).detach().cpu().numpy().copy() for i, m in enumerate(memory)}


class SequenceReplay:
    """Holds the last C sequences of T ticks; fields are arrays by name, laid out by the first sequences added."""

    def __init__(self, capacity: int, length: int) -> None:
        """Hold up to `capacity` sequences of `length` ticks.

        Raises:
            ValueError: If either is not positive.
        """
        if capacity < 1 or length < 1:
            raise ValueError(f"capacity {capacity} and length {length}: expected positive numbers")
        self.capacity, self.length = capacity, length
        self.size = 0
        """Sequences held now."""
        self._next = 0
        self._fields: dict[str, NDArray] = {}

    def add(self, ticks: Mapping[str, NDArray], starts: Mapping[str, NDArray]) -> None:
        """Add one sequence per robot.

        Args:
            ticks: Per-tick fields, [T, B, ...].
            starts: Per-sequence fields, such as the memory before the first tick, [B, ...].

        Raises:
            ValueError: If a field has another number of ticks.
        """
        for name, values in ticks.items():
            if len(values) != self.length:
                raise ValueError(f"field {name} has {len(values)} ticks: expected {self.length}")
        columns = {k: v.swapaxes(0, 1) for k, v in ticks.items()} | dict(starts)
        if not self._fields:
            self._fields = {k: np.zeros((self.capacity, *v.shape[1:]), v.dtype) for k, v in columns.items()}
        batch = len(next(iter(columns.values())))
        slots = (self._next + np.arange(batch)) % self.capacity
        for name, values in columns.items():
            self._fields[name][slots] = values
        self._next = int((self._next + batch) % self.capacity)
        self.size = min(self.size + batch, self.capacity)

    def sample(self, count: int, rng: np.random.Generator, device: torch.device | str = "cpu") -> dict[str, Tensor]:
        """Return a uniform draw of `count` sequences, [M, T, ...] and [M, ...], with replacement.

        Raises:
            ValueError: If the replay is empty.
        """
        if not self.size:
            raise ValueError("the replay is empty: add sequences before sampling")
        chosen = rng.integers(self.size, size=count)
        return {k: torch.from_numpy(v[chosen]).to(device) for k, v in self._fields.items()}
