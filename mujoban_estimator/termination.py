"""The control-termination classifier (paper C.4): shared ResNet, LSTM, probability that an instruction is completed.

Shapes: B robots, T ticks, P proprioceptive values, C channels and H = W = 16 rows and columns of the feature map,
Z values of what the camera says, L those of the LSTM.
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
from mujoban_core.grid import INSTRUCTION_LIMIT
from mujoban_core.interfaces import Memory, Termination, TerminationInput
from mujoban_core.ranges import check_counts
from mujoban_estimator.encoder import FEATURE_SIZE, FrameEncoder, check_frames
from mujoban_estimator.odometry import FEATURES, Odometry, Track, turn
from mujoban_rl.compiled import Compilable, bounded_sigmoid
from mujoban_rl.ticks import tick_arrays

PHASES: Final = 4
"""Cosine and sine of the robot's place within its cell, along and across the instruction."""
_PRIOR_LOGIT: Final = -3.0
_PROPRIO_SCALE: Final = 5.0


@dataclass(frozen=True)
class TerminationConfig:
    """Size of the network, and how beta follows from its probability."""

    body: str = "ball"
    stem: int = 16
    channels: int = 32
    blocks: int = 2
    camera: int = 64
    hidden: int = 96
    limit: int = INSTRUCTION_LIMIT
    sample: bool = False
    """Sample beta as in the paper, instead of comparing its probability with `threshold`."""
    threshold: float = 0.5

    def __post_init__(self) -> None:
        """Reject what is out of range."""
        check_counts(self, "stem", "channels", "blocks", "camera", "hidden", "limit")
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold is {self.threshold}: expected a number between 0 and 1")


class TerminationMemory(NamedTuple):
    """Memory of the classifier; the LSTM starts afresh with every instruction, the track with every episode."""

    hidden: Tensor
    """[B, L]."""
    cell: Tensor
    """[B, L]."""
    track: Track


class Verdicts(NamedTuple):
    """Outputs of a sequence of ticks."""

    logits: Tensor
    """Of p(beta), [B, T]."""
    phases: Tensor
    """What the camera says of the robot's place within its cell, [B, T, PHASES]; an auxiliary output."""
    hidden: Tensor
    cell: Tensor


class ControlTermination(Compilable, Termination):
    """Sequential binary classifier (o_cam, o_pr, A_{t-1}, beta_{t-1}) -> p_t(beta)."""

    def __init__(self, encoder: FrameEncoder | None = None, **config: str | int | float | bool) -> None:
        """Make the network from the fields of `TerminationConfig`; `encoder` is shared if given.

        Raises:
            ValueError: if a value is out of range or the body is unknown.
        """
        nn.Module.__init__(self)
        self.config = c = TerminationConfig(**config)  # pyright: ignore[reportArgumentType]
        Termination.__init__(self, limit=c.limit, sample=c.sample, threshold=c.threshold)
        body = get_body(c.body)
        self.odometry = Odometry(body)
        self.encoder = FrameEncoder(c.stem, c.channels, c.blocks) if encoder is None else encoder
        self.shrink = nn.Conv2d(c.channels, c.channels, 3, stride=2, padding=1)
        self.see = nn.Linear(c.channels * (FEATURE_SIZE // 2) ** 2, c.camera)
        self.turn = nn.Linear(FEATURES, c.camera)
        self.combine = nn.Sequential(nn.ReLU(), nn.Linear(c.camera, c.camera), nn.ReLU())
        self.phases = nn.Linear(c.camera, PHASES)
        self.lstm = nn.LSTM(c.camera + FEATURES + body.proprio_size, c.hidden, batch_first=True)
        self.verdict = nn.Sequential(nn.Linear(c.hidden, c.hidden), nn.ReLU(), nn.Linear(c.hidden, 1))
        nn.init.constant_(self.verdict[-1].bias, _PRIOR_LOGIT)  # pyright: ignore[reportArgumentType]

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.see.weight.device

    def hyperparameters(self) -> dict[str, str | int | float | bool]:
        """Return the configuration that rebuilds this module."""
        return asdict(self.config)

    def initial_recurrence(self, batch: int) -> tuple[Tensor, Tensor]:
        """Return the LSTM's state when an instruction is issued, two of [B, L]."""
        zeros = torch.zeros(batch, self.config.hidden, device=self.device)
        return zeros, zeros.clone()

    def forward(
        self, features: Tensor, progress: Tensor, proprio: Tensor, hidden: Tensor, cell: Tensor
    ) -> Verdicts:
        """Run over ticks of one instruction each, from the LSTM's given state.

        Args:
            features: what `encoder` makes of the frames, [B, T, C, H, W].
            progress: features of `odometry`, [B, T, FEATURES].
            proprio: o_pr, [B, T, P].
            hidden: [B, L]; zeros when the instruction has just been issued.
            cell: [B, L]; likewise.
        """
        b, t = features.shape[:2]
        seen = torch.relu(self.shrink(features.flatten(0, 1))).flatten(1).unflatten(0, (b, t))
        # The camera's word on where in its cell the robot is needs the heading, and must not copy the odometer.
        heading = torch.cat([progress[..., :2], torch.zeros_like(progress[..., 2:])], dim=-1)
        camera = self.combine(self.see(seen) + self.turn(heading))
        inputs = torch.cat([camera.float(), progress, (proprio / _PROPRIO_SCALE).clamp(-3, 3)], dim=-1)
        with torch.autocast(inputs.device.type, enabled=False):
            outputs, (hidden, cell) = self.lstm(inputs, (hidden[None], cell[None]))
        logits = self.verdict(outputs)[..., 0].float()
        return Verdicts(logits, self.phases(camera).float(), hidden[0], cell[0])

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory of `batch` robots at the start of an episode."""
        return TerminationMemory(*self.initial_recurrence(batch), self.odometry.initial(batch, self.device))

    @torch.inference_mode()
    def probability(self, inputs: TerminationInput, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return p(A_{t-1} is completed), [B], and the next memory.

        Raises:
            ValueError: if frames are not uint8 [B, 64, 64, 3] or proprioception is not finite.
        """
        check_frames(inputs.frame)
        if not np.isfinite(inputs.proprio).all():
            raise ValueError(f"proprioception {inputs.proprio.tolist()}: expected finite numbers")
        hidden, cell, track = memory
        arrays = tick_arrays(inputs)
        if self.compiled is not None and len(inputs.frame) == 1:
            probability, *after = self.compiled([*arrays, *(part.numpy() for part in (hidden, cell, *track))])
            hidden, cell, *parts = map(torch.from_numpy, after)
        else:
            tensors = (torch.from_numpy(x).to(self.device) for x in arrays)
            output, hidden, cell, *parts = self.tick(*tensors, hidden, cell, *track)
            probability = output.cpu().numpy()
        return probability, TerminationMemory(hidden, cell, Track(*parts))

    def tick(
        self, frame: Tensor, proprio: Tensor, instruction: Tensor, terminated: Tensor, hidden: Tensor, cell: Tensor,
        *track: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Return p(A_{t-1} is completed), [B], and the parts of the next memory.

        It is what `export` exports, hence tensors alone.

        Args:
            frame: o_cam, uint8 [B, 64, 64, 3].
            proprio: o_pr, [B, P].
            instruction: A_{t-1}, int64 [B].
            terminated: beta_{t-1}, bool [B].
            hidden: [B, L].
            cell: [B, L].
            track: The parts of `Track`.
        """
        felt = proprio[:, None]
        progress, after = self.odometry(felt, instruction[:, None], terminated[:, None], Track(*track))
        keep = (~terminated)[:, None].to(hidden.dtype)
        output = self(self.encoder(frame)[:, None], progress, felt, hidden * keep, cell * keep)
        return (bounded_sigmoid(output.logits[:, 0]), output.hidden, output.cell, *after)


def true_phases(pose: Tensor, direction: Tensor, cell_size: float) -> Tensor:
    """Return the label of `Verdicts.phases`, [B, T, PHASES].

    Args:
        pose: (x [m], y [m], psi [rad]) in the map frame, [B, T, 3].
        direction: unit vector of the instruction in force, zero for `stay`, [B, T, 2].
        cell_size: edge of a cell in metres.
    """
    # Cell centres lie at half-integers of the map.
    place = turn(pose[..., :2] / cell_size - 0.5, direction) * (2 * math.pi)
    return torch.cat([place.cos(), place.sin()], dim=-1)
