"""A learned answer to where to look before pushing: an exploration policy over estimates.

It says a step towards a view, a turn on the spot, or that there is nothing more to look for; it pushes nothing.

Shapes: B states, N = `grid.GRID_SIZE`, I = 8 rows and columns of the interior, A = 5 instructions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.bodies import get_body
from mujoban_core.grid import Instruction
from mujoban_core.look_around import Scout
from mujoban_planner.exploration_env import DISTANCE, FIRST, observe_estimate
from mujoban_planner.networks import ResidualBlock
from mujoban_rl.weights import load_weights

_IMPOSSIBLE: Final = -1e4
"""Logit and value of an instruction that leads to no cell that is believed to be free."""
_SCALE: Final = (1.0, 1.0, 1.0, 1.0, 1.0, 0.1, 0.1)
"""Of the channels that the network reads: all but the first step."""
_PLANES: Final = len(_SCALE)


class ExplorerOutput(NamedTuple):
    """What the network says about states."""

    policy: Tensor
    """Logits of the instructions, [B, A]; STAY is a turn on the spot."""
    q: Tensor
    """What each brings to see, less what it and all that follows it cost, [B, A]."""


class Explorer(nn.Module, Scout):
    """Residual network over the board that says what a turn is worth here, and what going to each other cell.

    The way there is walked by rule: a step is worth what the best place is to which it is the first, less a learned
    cost of every step. What a turn at each place would show is told to the network (`viewpoints.survey`);
    whether it is worth the way, and where nothing is, it learns.
    """

    def __init__(self, channels: int = 32, blocks: int = 4, body: str = "ball") -> None:
        """Build the network; it is told what the camera of a body would see.

        Raises:
            ValueError: If the body is unknown.
        """
        super().__init__()
        self.config = {"channels": channels, "blocks": blocks, "body": body}
        self._body = get_body(body)
        self.encoder = nn.Conv2d(_PLANES, channels, 3, padding=1)
        self.blocks = nn.Sequential(*(ResidualBlock(channels) for _ in range(blocks)))
        self.places = nn.Conv2d(channels + _PLANES, 2 * len(ExplorerOutput._fields), 1)
        self.step_cost = nn.Parameter(torch.full((len(ExplorerOutput._fields),), -3.0))

    def forward(self, states: Tensor) -> ExplorerOutput:
        """Return policy and Q-values of states, float32 [B, N, N, 8] (see `exploration_env.observe_estimate`)."""
        inner = states[:, 1:-1, 1:-1]
        scale = inner.new_tensor(_SCALE)
        planes = (inner[..., : len(_SCALE)] * scale).permute(0, 3, 1, 2)
        worth = self.places(torch.cat([self.blocks(self.encoder(planes)), planes], 1))
        distance, first = inner[..., DISTANCE], inner[..., FIRST]
        here = (distance == 0.0)[:, None]
        turn, go = worth.chunk(2, 1)
        worth = torch.where(here, turn, go - functional.softplus(self.step_cost)[:, None, None] * distance[:, None])
        leads = (first[:, None] == torch.arange(len(Instruction), device=states.device)[:, None, None]) & (
            distance[:, None] >= 0.0
        )
        # Shape [B, 2, A, I * I].
        values = worth[:, :, None].masked_fill(~leads[:, None], _IMPOSSIBLE).flatten(3)
        return ExplorerOutput(values[:, 0].logsumexp(-1), values[:, 1].amax(-1))

    @torch.inference_mode()
    def step(self, abstract_state: NDArray[np.float32], shown: NDArray[np.bool_]) -> Instruction | None:
        """Return the likeliest instruction, None where it is not worth its cost; see `Scout.step`."""
        state = torch.from_numpy(observe_estimate(abstract_state, shown, self._body))[None]
        policy, q = self(state.to(self.step_cost.device))
        best = int(policy.argmax())
        return Instruction(best) if q[0, best] > 0.0 else None


def load(path: str | Path, device: str = "cpu") -> Explorer:
    """Return an explorer with trained weights.

    Args:
        path: A `.safetensors` file with its record beside; none ships.
        device: Where the network is put.

    Raises:
        WeightsError: If the weights are missing, damaged or not an explorer's.
    """
    return load_weights(Explorer, path, device)
