"""Replay of vectorised experience in tensors, on any device.

Time-major rings keep successive steps of an environment together, so that n-step returns are read off at sampling time.

Shapes: T steps kept, E environments, B batch, n steps of a return.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


class TimeMajorReplay:
    """The last T steps of E environments."""

    def __init__(
        self,
        steps: int,
        environments: int,
        fields: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
        device: str = "cpu",
    ) -> None:
        """Allocate room.

        Args:
            steps: T.
            environments: E.
            fields: Shape, without batch axes, and type of each field.
            device: Where the tensors live.
        """
        self.steps, self.environments = steps, environments
        self.device = torch.device(device)
        self.storage = {
            name: torch.zeros((steps, environments, *shape), dtype=dtype, device=self.device)
            for name, (shape, dtype) in fields.items()
        }
        self.added = 0
        """Steps added so far."""

    def __len__(self) -> int:
        """Return the number of steps kept."""
        return min(self.added, self.steps)

    def add(self, values: Mapping[str, Tensor]) -> None:
        """Append one step of every environment, [E, ...] each.

        Raises:
            ValueError: If the fields are not those of the replay.
        """
        if values.keys() != self.storage.keys():
            raise ValueError(f"fields {sorted(values)}: expected {sorted(self.storage)}")
        slot = self.added % self.steps
        for name, value in values.items():
            self.storage[name][slot] = value
        self.added += 1

    def sample(self, batch: int, n: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Return windows of n + 1 successive steps from uniform starts, each field [B, n + 1, ...].

        Raises:
            ValueError: If fewer than n + 1 steps are there.
        """
        if len(self) < n + 1:
            raise ValueError(f"{len(self)} steps in the replay: expected at least {n + 1}")
        oldest = self.added - len(self)
        start = torch.randint(oldest, self.added - n, (batch,), generator=generator).to(self.device)
        row = torch.randint(0, self.environments, (batch,), generator=generator).to(self.device)
        slots = (start[:, None] + torch.arange(n + 1, device=self.device)) % self.steps
        return {name: values[slots, row[:, None]] for name, values in self.storage.items()}
