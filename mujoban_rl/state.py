"""What changes in a part of a run beside its modules and optimisers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class State:
    """What changes in a part of a run beside its modules and optimisers."""

    values: dict[str, Any] = field(default_factory=dict)
    """JSON values: random states, counters."""
    tensors: dict[str, Tensor] = field(default_factory=dict)
    """Replay, recurrent states, `torch.Generator` states."""

    @classmethod
    def of(cls, parts: Mapping[str, State]) -> State:
        """Return the state of a whole, given those of its parts by name; names must be without dots."""
        return cls(
            {name: state.values for name, state in parts.items()},
            {f"{name}.{k}": tensor for name, state in parts.items() for k, tensor in state.tensors.items()},
        )

    def part(self, name: str) -> State:
        """Return the state of one part of a whole."""
        prefix = f"{name}."
        tensors = {k.removeprefix(prefix): v for k, v in self.tensors.items() if k.startswith(prefix)}
        return State(self.values[name], tensors)
