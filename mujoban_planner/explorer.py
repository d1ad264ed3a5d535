"""A learned answer to where to look before pushing: an exploration policy over estimates.

It says a step towards a view, a turn on the spot, or that there is nothing more to look for; it pushes nothing.

Shapes: B states, N = `grid.GRID_SIZE`, I = 8 rows and columns of the interior, C channels, A = 5 instructions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import AGENT, BOX, GRID_SIZE, OFFSETS_RC, WALL, Instruction
from mujoban_core.look_around import Scout
from mujoban_core.viewpoints import FREE
from mujoban_planner.exploration_env import CHANNELS
from mujoban_planner.networks import ResidualBlock
from mujoban_rl.weights import load_weights

_IMPOSSIBLE: Final = -1e4
"""Logit of a step into a cell that is not believed to be free."""


SHIPPED: Final = Path(__file__).parent / "weights" / "explorer.safetensors"
"""The weights that ship."""


class ExplorerOutput(NamedTuple):
    """What the network says about states."""

    policy: Tensor
    """Logits of the instructions, [B, A]; STAY is a turn on the spot."""
    q: Tensor
    """What each brings to see, less what it and all that follows it cost, [B, A]."""


class Explorer(nn.Module, Scout):
    """Residual network over the board, read out where the robot is."""

    offsets: Tensor

    def __init__(self, channels: int = 32, blocks: int = 4) -> None:
        """Build the network."""
        super().__init__()
        self.config = {"channels": channels, "blocks": blocks}
        self.encoder = nn.Conv2d(CHANNELS, channels, 3, padding=1)
        self.blocks = nn.Sequential(*(ResidualBlock(channels) for _ in range(blocks)))
        self.mix = nn.Linear(3 * channels, 2 * channels)
        self.policy = nn.Linear(2 * channels, len(Instruction))
        self.q = nn.Linear(2 * channels, len(Instruction))
        offsets = OFFSETS_RC[:, 0] * GRID_SIZE + OFFSETS_RC[:, 1]
        self.register_buffer("offsets", torch.from_numpy(offsets[1:].copy()), persistent=False)

    def forward(self, states: Tensor) -> ExplorerOutput:
        """Return policy and Q-values of states, float32 [B, N, N, 5] (see `ExplorationEnvironment`)."""
        agent = states[..., AGENT]
        x = self.blocks(self.encoder(states[:, 1:-1, 1:-1].permute(0, 3, 1, 2)))
        here = (x * agent[:, None, 1:-1, 1:-1]).sum((2, 3))
        features = functional.relu(self.mix(torch.cat([here, x.mean((2, 3)), x.amax((2, 3))], 1)))
        policy = self.policy(features).masked_fill(~self.possible(states), _IMPOSSIBLE)
        return ExplorerOutput(policy, self.q(features))

    def possible(self, states: Tensor) -> Tensor:
        """Return which instructions there are: no steps into walls, boxes or the border, bool [B, A]."""
        free = (states[..., WALL] < FREE) & (states[..., BOX] < FREE)
        free[:, [0, -1]] = free[:, :, [0, -1]] = False
        at = states[..., AGENT].flatten(1).argmax(1)
        moves = free.flatten(1).gather(1, (at[:, None] + self.offsets).clamp(0, GRID_SIZE**2 - 1))
        return torch.cat([torch.ones_like(moves[:, :1]), moves], 1)

    @torch.inference_mode()
    def step(self, abstract_state: NDArray[np.float32], shown: NDArray[np.bool_]) -> Instruction | None:
        """Return the likeliest instruction, None where it is not worth its cost; see `Scout.step`."""
        state = np.concatenate([abstract_state, shown[..., None]], -1).astype(np.float32)
        policy, q = self(torch.from_numpy(state)[None])
        best = int(policy.argmax())
        return Instruction(best) if q[0, best] > 0.0 else None


def load(path: str | Path | None = None, device: str = "cpu") -> Explorer:
    """Return an explorer with trained weights.

    Args:
        path: A `.safetensors` file with its record beside; the shipped weights by default.
        device: Where the network is put.

    Raises:
        WeightsError: If the weights are missing, damaged or not an explorer's.
    """
    return load_weights(Explorer, Path(path or SHIPPED), device)
