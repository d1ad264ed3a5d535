"""The planner's architectures behind one class, `LearnedPlanner` (paper C.2).

- `RecurrentPlanner`, the paper's: a repeated ConvLSTM (DRC, Guez et al. 2019), feed-forward in time, with a
  trainable initial hidden state;
- `ResidualPlanner`, a residual convolutional network with the same heads;
- `ThinkingPlanner`, that network with its last blocks repeated as often as time allows.

Shapes: B states, I = 8 rows and columns of the interior, C channels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_planner.heads import INTERIOR, Advice, PlannerHeads, PoolAndInject
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.symmetry import SYMMETRIES, average_instructions, average_pushes, view_states


class ResidualBlock(nn.Module):
    """Pre-activation block without normalisation; its last convolution starts at zero, hence as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.inject = PoolAndInject(channels, channels)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(_bias(self.second))

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, C, I, I] from [B, C, I, I]."""
        h = self.first(functional.relu(x))
        return x + self.second(functional.relu(h + self.inject(h)))


class ResidualPlanner(LearnedPlanner):
    """Residual network over the board.

    Its thinking time is the number of symmetric views of the board whose outputs it averages, in one forward pass.
    Each decision takes the next ones of the eight, until the boxes move.
    """

    def __init__(self, channels: int = 64, blocks: int = 8, propagation: bool = True, judge: bool = False) -> None:
        """Build `blocks` residual blocks of `channels` channels."""
        super().__init__(channels=channels, blocks=blocks, propagation=propagation, judge=judge)
        self.encoder = nn.Conv2d(self.inputs, channels, 3, padding=1)
        self.blocks = nn.Sequential(*(ResidualBlock(channels) for _ in range(blocks)))
        self.readout = PlannerHeads(channels, propagation=propagation, judge=judge)

    def features(self, planes: Tensor) -> Tensor:
        """Return features [B, C, I, I] of planes [B, `inputs`, I, I]."""
        return self.blocks(self.encoder(planes))

    @property
    def views(self) -> int:
        """Symmetric views of the board that go into one decision, at most 8."""
        return min(max(self.thinking, 1), SYMMETRIES)

    @property
    def perspectives(self) -> int:
        """The eight symmetric views of the board."""
        return SYMMETRIES

    def advise(self, states: Tensor, seen: Tensor) -> Advice:
        """Return the mean advice over the next `views` symmetric views."""
        symmetries = (seen[:, None] + torch.arange(self.views, device=seen.device)) % SYMMETRIES
        policy, alive, push, push_alive = super().advise(view_states(states, symmetries), seen)
        return Advice(
            average_instructions(policy, symmetries),
            average_instructions(alive, symmetries),
            average_pushes(push, symmetries),
            average_pushes(push_alive, symmetries),
        )


class ThinkingPlanner(ResidualPlanner):
    """Residual network whose last blocks are repeated with the same weights, `thinking` times in each decision.

    What was taught with several numbers of repeats can be left to think longer than it was taught (Schwarzschild et
    al. 2021). With one repeat it is the `ResidualPlanner` of these weights.
    """

    def __init__(
        self, channels: int = 64, blocks: int = 12, tied: int = 6, propagation: bool = True, judge: bool = False
    ) -> None:
        """Build `blocks` residual blocks of `channels` channels, the last `tied` of which are repeated.

        Raises:
            ValueError: If there are not so many blocks.
        """
        if not 0 < tied <= blocks:
            raise ValueError(f"tied is {tied}: expected from 1 to all {blocks} blocks")
        super().__init__(channels, blocks, propagation, judge)
        self._config["tied"] = tied
        self._tied = tied

    def features(self, planes: Tensor) -> Tensor:
        """Return features [B, C, I, I] of planes [B, `inputs`, I, I]."""
        x = self.blocks[: -self._tied](self.encoder(planes))
        for _ in range(max(self.thinking, 1)):
            x = self.blocks[-self._tied :](x)
        return x

    @property
    def views(self) -> int:
        """Symmetric views of the board that go into one decision: it has other ways to think longer."""
        return 1


class ConvLSTMCell(nn.Module):
    """ConvLSTM cell with pool-and-inject, tanh output and a residual highway (Guez et al. 2019, appendix).

    What makes it learn quickly: gates that start large enough, forget and output bias +1, and the encoder's part of
    the gates computed once for all repeats.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.encode = nn.Conv2d(channels, 4 * channels, 3, padding=1)
        self.gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1, bias=False)
        self.inject = PoolAndInject(channels, 4 * channels)
        nn.init.normal_(self.encode.weight, 0.0, (9 * channels) ** -0.5)
        nn.init.normal_(self.gates.weight, 0.0, (18 * channels) ** -0.5)
        bias = _bias(self.encode)
        nn.init.zeros_(bias)
        with torch.no_grad():
            bias[channels : 3 * channels] += 1.0  # forget and output gates

    def forward(self, encoded: Tensor, below: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next hidden and cell state, [B, C, I, I].

        Args:
            encoded: Gate inputs from the encoder, `encode(e)`, [B, 4C, I, I].
            below: What comes up the highway, [B, C, I, I].
            hidden: Hidden state, [B, C, I, I].
            cell: Cell state, [B, C, I, I].
        """
        gates = encoded + self.gates(torch.cat([below, hidden], 1)) + self.inject(hidden)
        enter, forget, leave, value = gates.chunk(4, 1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(enter) * torch.tanh(value)
        return torch.sigmoid(leave) * torch.tanh(cell), cell


class RecurrentPlanner(LearnedPlanner):
    """The paper's planner: `depth` ConvLSTM layers repeated `repeats` times (DRC), feed-forward in time.

    Hidden states start from a trainable variable and are not carried through time (paper C.2). `thinking` multiplies
    the repeats at decision time.
    """

    def __init__(
        self,
        channels: int = 32,
        depth: int = 3,
        repeats: int = 3,
        propagation: bool = False,
        judge: bool = False,
    ) -> None:
        """Build DRC(depth, repeats) with `channels` channels."""
        super().__init__(channels=channels, depth=depth, repeats=repeats, propagation=propagation, judge=judge)
        self.repeats = repeats
        self.encoder = nn.Sequential(
            nn.Conv2d(self.inputs, channels, 3, padding=1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1)
        )
        self.cells = nn.ModuleList([ConvLSTMCell(channels) for _ in range(depth)])
        self.initial = nn.Parameter(torch.zeros(depth, 2, channels, INTERIOR, INTERIOR))
        self.readout = PlannerHeads(channels, propagation=propagation, judge=judge)

    def features(self, planes: Tensor) -> Tensor:
        """Return features [B, C, I, I] of planes [B, `inputs`, I, I]."""
        encoded = self.encoder(planes)
        inputs = [cell.encode(functional.relu(encoded)) for cell in self._cells()]
        start = self.initial[:, :, None].expand(-1, -1, len(planes), -1, -1, -1).to(encoded.dtype)
        hidden, memory = list(start[:, 0]), list(start[:, 1])
        highway = encoded
        for _ in range(self.repeats * max(self.thinking, 1)):
            for layer, cell in enumerate(self._cells()):
                hidden[layer], memory[layer] = cell(inputs[layer], highway, hidden[layer], memory[layer])
                highway = highway + hidden[layer]
        return highway

    def _cells(self) -> list[ConvLSTMCell]:
        return [cell for cell in self.cells if isinstance(cell, ConvLSTMCell)]


def _bias(layer: nn.Conv2d) -> nn.Parameter:
    assert isinstance(layer.bias, nn.Parameter)
    return layer.bias


ARCHITECTURES: dict[str, type[LearnedPlanner]] = {
    cls.__name__: cls for cls in (ResidualPlanner, ThinkingPlanner, RecurrentPlanner)
}
"""Architecture by the name of its class, as in the records of weights."""
