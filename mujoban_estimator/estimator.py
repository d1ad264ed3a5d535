"""The geometry-aware state estimator (paper C.1, Fig. 6).

Shapes: B robots, T ticks, N = B * T frames, M = 100 cells, A anchors of a cell, H = W = 16 rows and columns of the
feature map, C its channels, D channels of a cell's embedding, L those of the belief.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_core.bodies import get_body
from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE, TARGET, WALL
from mujoban_core.interfaces import Estimator, EstimatorInput, Memory
from mujoban_core.ranges import check_counts
from mujoban_estimator.encoder import FEATURE_SIZE, FrameEncoder, check_frames
from mujoban_estimator.geometry import ANCHORS, CELLS, FEATURES, cell_geometry
from mujoban_rl.compiled import Compilable, bounded_sigmoid

BINARY: Final = (WALL, TARGET, BOX)
"""Layers with an independent classifier per cell; the agent's is one softmax over all cells."""
_GROUPS: Final = 4
"""Groups in which frames attend."""
_PRIOR_LOGITS: Final = {WALL: 0.0, TARGET: -3.0, AGENT: 0.0, BOX: -3.0}


@dataclass(frozen=True)
class EstimatorConfig:
    """Size of the network, body that carries the camera, and how often the belief is updated."""

    body: str = "ball"
    """Name of the body."""
    stem: int = 16
    """Channels of the first convolution."""
    channels: int = 32
    """Channels of those after it."""
    blocks: int = 2
    """Residual blocks after them."""
    embedding: int = 64
    belief: int = 32
    """Channels of the belief in each cell."""
    update_every: int = 4
    """Ticks from one update of the belief to the next; in between the estimate is held."""

    def __post_init__(self) -> None:
        """Reject bodies that are unknown and sizes that are not positive."""
        get_body(self.body)
        check_counts(self, "stem", "channels", "blocks", "embedding", "belief", "update_every")


class Belief(NamedTuple):
    """State of the ConvLSTM: the implicit belief over the abstract state."""

    hidden: Tensor
    """[B, L, 10, 10]."""
    cell: Tensor
    """[B, L, 10, 10]."""


class Estimates(NamedTuple):
    """Outputs of a sequence of frames."""

    logits: Tensor
    """Of the abstract state, [B, T, 10, 10, 4]; the agent's layer is normalised over its 100 cells."""
    frame_logits: Tensor
    """What each frame alone says of wall, target and box, [B, T, 10, 10, 3]; an auxiliary output."""
    belief: Belief


class GeometricAttention(nn.Module):
    """One attention map per cell and anchor over the feature map, given where the cell is relative to the robot.

    The logit of pixel (row, column) is that of a Gaussian around the anchor's projection plus a learned function of
    the cell's relative coordinates and the pixel's, a sum of one part per row and one per column. The Gaussian starts
    with the width of a pixel and is learned; without it attention takes ten times as long to find the cells.
    """

    centres: Tensor
    """Centres of rows and columns in the frame, [16]."""

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.learned = nn.Sequential(
            nn.Linear(FEATURES, hidden), nn.ReLU(), nn.Linear(hidden, len(ANCHORS) * 2 * FEATURE_SIZE)
        )
        last = self.learned[-1]
        nn.init.zeros_(last.weight)  # pyright: ignore[reportArgumentType]
        nn.init.zeros_(last.bias)  # pyright: ignore[reportArgumentType]
        pixel = 2.0 / FEATURE_SIZE
        self.log_width = nn.Parameter(torch.full((len(ANCHORS), 2), math.log(0.7 * pixel)))
        centres = (np.arange(FEATURE_SIZE) + 0.5) * pixel - 1.0
        self.register_buffer("centres", torch.tensor(centres, dtype=torch.float32), persistent=False)

    def forward(self, features: Tensor, relative: Tensor, pixels: Tensor, visible: Tensor) -> Tensor:
        """Return the features at which each cell's anchors look; zeros for anchors out of the frame.

        Args:
            features: [N, C, H, W].
            relative: relative coordinates of cells, [N, M, FEATURES].
            pixels: projected anchors (right, down), [N, M, A, 2].
            visible: 1 for anchors within the frame, [N, M, A].

        Returns:
            [N, M, A * C].
        """
        n, channels = features.shape[:2]
        logits = self._logits(relative, pixels).flatten(1, 2)  # [N, M * A, 2, 16]
        # Shape [N, H * W, C]
        values = features.permute(0, 2, 3, 1).reshape(n, -1, channels)
        shown = visible.flatten(1)
        if n == 1:  # to compute all costs less than to choose, and has one shape
            return (_attend(logits, values) * shown[..., None].to(values.dtype)).reshape(1, CELLS, -1)
        counts = shown.sum(dim=1)
        # Most anchors are out of the frame. Frames are grouped by how many they show, which saves most of the work.
        order = torch.argsort(shown, dim=1, descending=True, stable=True)
        looked = values.new_zeros(n, shown.shape[1], channels)
        for frames in torch.argsort(counts).split(-(-n // _GROUPS)):
            row = frames[:, None]
            column = order[frames, : max(int(counts[frames[-1]]), 1)]
            part = _attend(logits[row, column], values[frames]) * shown[row, column][..., None].to(values.dtype)
            looked = looked.index_put((row, column), part)
        return looked.reshape(n, CELLS, -1)

    def _logits(self, relative: Tensor, pixels: Tensor) -> Tensor:
        """Return attention logits per row and column of the feature map, [N, M, A, 2, 16]."""
        distance = self.centres - pixels[..., None]
        prior = -0.5 * (distance * torch.exp(-self.log_width)[..., None]) ** 2
        return prior + self.learned(relative).float().reshape(prior.shape)


def _attend(logits: Tensor, values: Tensor) -> Tensor:
    """Return attended features [N, S, C]: logits per column and row [N, S, 2, 16], values [N, H * W, C]."""
    across, down = logits.unbind(dim=-2)
    # Shape [N, S, H * W]
    attention = torch.softmax((down[..., :, None] + across[..., None, :]).flatten(-2), dim=-1)
    return torch.bmm(attention.to(values.dtype), values)


class ConvLSTM(nn.Module):
    """Convolutional LSTM over the map (Shi et al. 2015); gates of the input are computed for all ticks at once."""

    def __init__(self, inputs: int, belief: int) -> None:
        super().__init__()
        self.belief = belief
        self.from_input = nn.Conv2d(inputs, 4 * belief, 1)
        self.from_hidden = nn.Conv2d(belief, 4 * belief, 3, padding=1, bias=False)
        assert self.from_input.bias is not None
        with torch.no_grad():
            # Order of the gates: input, forget, candidate, output. Cells keep what they hold unless told otherwise.
            self.from_input.bias[belief : 2 * belief] = 1.5

    def forward(self, inputs: Tensor, state: Belief) -> tuple[Tensor, Belief]:
        """Return hidden states [B, T, L, 10, 10] and the last state; `inputs` is [B, T, D, 10, 10]."""
        gates = self.from_input(inputs.flatten(0, 1)).unflatten(0, inputs.shape[:2])
        hidden, cell = state
        steps = []
        for gate in gates.unbind(dim=1):
            enter, keep, candidate, leave = (gate + self.from_hidden(hidden)).float().chunk(4, dim=1)
            cell = torch.sigmoid(keep) * cell + torch.sigmoid(enter) * torch.tanh(candidate)
            hidden = torch.sigmoid(leave) * torch.tanh(cell)
            steps.append(hidden)
        return torch.stack(steps, dim=1), Belief(hidden, cell)


class StateEstimator(Compilable, Estimator):
    """Recurrent classifier (o_cam, o_pos) -> s_abst.

    Memory: belief (two [B, L, 10, 10]), ticks since the episode's start [B], and the estimate held [B, 10, 10, 4].
    """

    def __init__(self, encoder: FrameEncoder | None = None, **config: str | int) -> None:
        """Make the network from the fields of `EstimatorConfig`; `encoder` is shared if given.

        Raises:
            ValueError: if a size is not positive or the body is unknown.
        """
        super().__init__()
        self.config = c = EstimatorConfig(**config)  # pyright: ignore[reportArgumentType]
        self.body = get_body(c.body)
        self.encoder = FrameEncoder(c.stem, c.channels, c.blocks) if encoder is None else encoder
        self.attention = GeometricAttention()
        attended = len(ANCHORS) * (c.channels + 1) + FEATURES
        self.embed = nn.Sequential(nn.Linear(attended, c.embedding), nn.ReLU())
        self.memory = ConvLSTM(c.embedding, c.belief)
        self.classify = nn.Sequential(
            nn.Conv2d(c.belief + c.embedding, 64, 1), nn.ReLU(), nn.Conv2d(64, len(CHANNELS), 1)
        )
        self.classify_frame = nn.Conv2d(c.embedding, len(BINARY), 1)
        self._set_prior()

    def _set_prior(self) -> None:
        """Start the classifiers near how often each layer is set."""
        last, frame = self.classify[-1].bias, self.classify_frame.bias
        with torch.no_grad():
            for layer, logit in _PRIOR_LOGITS.items():
                last[layer] = logit  # pyright: ignore
            for i, layer in enumerate(BINARY):
                frame[i] = _PRIOR_LOGITS[layer]  # pyright: ignore

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.attention.log_width.device

    def hyperparameters(self) -> dict[str, str | int]:
        """Return the configuration that rebuilds this module."""
        return asdict(self.config)

    def initial_belief(self, batch: int) -> Belief:
        """Return the belief at the start of episodes."""
        zeros = torch.zeros(batch, self.config.belief, GRID_SIZE, GRID_SIZE, device=self.device)
        return Belief(zeros, zeros.clone())

    def forward(self, features: Tensor, pose: NDArray[np.floating], belief: Belief) -> Estimates:
        """Run over sequences of frames that the belief takes in one after the other.

        Args:
            features: what `encoder` makes of the frames, [B, T, C, H, W].
            pose: (x [m], y [m], psi [rad]) in the map frame, [B, T, 3].
            belief: at the start of the sequences.
        """
        geometry = cell_geometry(pose.reshape(-1, 3), self.body.camera, self.body.cell_size)
        relative, pixels, visible = (torch.from_numpy(g).to(features.device) for g in geometry)
        return self._take_in(features, relative, pixels, visible, belief)

    def _take_in(
        self, features: Tensor, relative: Tensor, pixels: Tensor, visible: Tensor, belief: Belief
    ) -> Estimates:
        """Return what `forward` does, given where each cell is in each frame; see `cell_geometry`."""
        b, t = features.shape[:2]
        looked = self.attention(features.flatten(0, 1), relative, pixels, visible)
        cells = self.embed(torch.cat([looked, visible.to(looked.dtype), relative.to(looked.dtype)], dim=-1))
        # Shape [N, D, 10, 10]
        cells = cells.transpose(1, 2).unflatten(2, (GRID_SIZE, GRID_SIZE))
        hidden, belief = self.memory(cells.unflatten(0, (b, t)), belief)
        logits = self.classify(torch.cat([hidden.flatten(0, 1).to(cells.dtype), cells], dim=1))
        outputs = (x.float().permute(0, 2, 3, 1).unflatten(0, (b, t)) for x in (logits, self.classify_frame(cells)))
        return Estimates._make([*outputs, belief])

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory of `batch` robots at the start of an episode."""
        held = torch.zeros(batch, GRID_SIZE, GRID_SIZE, len(CHANNELS))
        return (*self.initial_belief(batch), torch.zeros(batch, dtype=torch.int64), held)

    @torch.inference_mode()
    def step(self, inputs: EstimatorInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the probability of each layer in each cell, [B, 10, 10, 4], and the next memory.

        Rows take in the frame every `update_every` ticks of their episode, and hold their estimate in between.

        Raises:
            ValueError: if frames are not uint8 [B, 64, 64, 3] or poses not finite.
        """
        check_frames(inputs.frame)
        if not np.isfinite(inputs.pose).all():
            raise ValueError(f"pose {inputs.pose.tolist()}: expected finite numbers")
        hidden, cell, tick, held = state
        rows = torch.nonzero(tick % self.config.update_every == 0)[:, 0]
        if len(rows) == 0:
            return held.numpy().copy(), (hidden, cell, tick + 1, held)
        if self.compiled is not None and len(tick) == 1:
            geometry = cell_geometry(inputs.pose, self.body.camera, self.body.cell_size)
            frame = np.ascontiguousarray(inputs.frame)
            held, hidden, cell = map(
                torch.from_numpy, self.compiled([frame, *geometry, hidden.numpy(), cell.numpy()])
            )
            return held.numpy().copy(), (hidden, cell, tick + 1, held)
        index = rows.numpy()
        features = self.encoder(torch.from_numpy(inputs.frame[index]).to(self.device))
        chosen = rows.to(self.device)
        output = self(features[:, None], inputs.pose[index][:, None], Belief(hidden[chosen], cell[chosen]))
        hidden = hidden.index_copy(0, chosen, output.belief.hidden)
        cell = cell.index_copy(0, chosen, output.belief.cell)
        held = held.index_copy(0, rows, probabilities(output.logits[:, 0]).cpu())
        return held.numpy().copy(), (hidden, cell, tick + 1, held)

    def update(
        self, frame: Tensor, relative: Tensor, pixels: Tensor, visible: Tensor, hidden: Tensor, cell: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the probability of each layer in each cell, [B, 10, 10, 4], and the two parts of the belief.

        It is what `export` exports, hence tensors alone.

        Args:
            frame: o_cam, uint8 [B, 64, 64, 3].
            relative: Where the cells are, as `cell_geometry` says it.
            pixels: Likewise.
            visible: Likewise.
            hidden: [B, L, 10, 10].
            cell: [B, L, 10, 10].
        """
        seen = self.encoder(frame)[:, None]
        output = self._take_in(seen, relative, pixels, visible, Belief(hidden, cell))
        return probabilities(output.logits[:, 0]), output.belief.hidden, output.belief.cell


def probabilities(logits: Tensor) -> Tensor:
    """Return the probability of each layer in each cell; both [..., 10, 10, 4]."""
    binary = bounded_sigmoid(logits)
    agent = torch.softmax(logits[..., AGENT].flatten(-2), dim=-1).unflatten(-1, (GRID_SIZE, GRID_SIZE))
    binary[..., AGENT] = agent
    return binary
