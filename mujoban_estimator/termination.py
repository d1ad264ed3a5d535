"""The control-termination classifier (paper C.4): shared ResNet, LSTM, probability that an instruction is completed.

Shapes: B robots, T ticks, P proprioceptive values, C channels and H = W = 16 rows and columns of the feature map,
S values of what is seen in a frame, Z of what the camera says, K of what it shows of heading and place, L of the LSTM.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_core.bodies import get_body
from mujoban_core.grid import INSTRUCTION_LIMIT
from mujoban_core.interfaces import Memory, Termination, TerminationInput, check_termination
from mujoban_core.ranges import check_counts
from mujoban_estimator.bearings import BEARINGS, Bearings, Progress, follow
from mujoban_estimator.encoder import FEATURE_SIZE, FrameEncoder, check_frames
from mujoban_estimator.odometry import FEATURES, Odometry, Track
from mujoban_rl.compiled import Compilable, bounded_sigmoid
from mujoban_rl.sight.place import PLACE
from mujoban_rl.ticks import tick_arrays

_PRIOR_LOGIT: Final = -3.0
_PROPRIO_SCALE: Final = 5.0


@dataclass(frozen=True)
class TerminationConfig:
    """Size of the network, and how beta follows from its probability."""

    body: str = "ball"
    """Name of the body."""
    stem: int = 16
    """Channels of the first convolution."""
    channels: int = 32
    """Channels of those after it."""
    blocks: int = 2
    """Residual blocks after them."""
    camera: int = 64
    """Features that are read from a frame."""
    hidden: int = 96
    """Width of the memory."""
    limit: int = INSTRUCTION_LIMIT
    """Ticks after which beta is forced."""
    sample: bool = False
    """Sample beta as in the paper, instead of comparing its probability with `threshold`."""
    threshold: float = 0.5
    """Probability above which beta is true where it is not sampled."""

    def __post_init__(self) -> None:
        """Reject what is out of range."""
        get_body(self.body)
        check_counts(self, "stem", "channels", "blocks", "camera", "hidden")
        check_termination(limit=self.limit, threshold=self.threshold)


class TerminationMemory(NamedTuple):
    """Memory of the classifier; the LSTM starts afresh with every instruction, the track with every episode."""

    hidden: Tensor
    """[B, L]."""
    cell: Tensor
    """[B, L]."""
    track: Track
    needles: tuple[Tensor, ...] = ()
    """Those of `Bearings`, [B, NEEDLES], if the body does not feel its heading."""


class Verdicts(NamedTuple):
    """Outputs of a sequence of ticks."""

    logits: Tensor
    """Of p(beta), [B, T]."""
    phases: Tensor
    """What the camera says of the robot's place within its cell, [B, T, `PLACE`]; an auxiliary output."""
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
        seen = c.channels * (FEATURE_SIZE // 2) ** 2
        self.bearings = Bearings(body, seen) if body.heading_index is None else None
        features = FEATURES if self.bearings is None else FEATURES + BEARINGS
        self.see = nn.Linear(seen, c.camera)
        self.turn = nn.Linear(FEATURES, c.camera)
        self.combine = nn.Sequential(nn.ReLU(), nn.Linear(c.camera, c.camera), nn.ReLU())
        self.phases = nn.Linear(c.camera, PLACE)
        self.lstm = nn.LSTM(c.camera + features + body.proprio_size, c.hidden, batch_first=True)
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

    def initial_needles(self, batch: int) -> tuple[Tensor, ...]:
        """Return the needles at the start of an episode: one [B, NEEDLES], or none."""
        return () if self.bearings is None else (self.bearings.initial(batch, self.device),)

    def look(self, features: Tensor) -> Tensor:
        """Return what is seen in frames, flat [M, S], given what `encoder` makes of them, [M, C, H, W]."""
        return torch.relu(self.shrink(features)).flatten(1)

    def read(self, frame: Tensor, seen: Tensor, proprio: Tensor) -> Tensor | None:
        """Return what frames show of heading and place, [M, K]; None for a body that feels its heading.

        Args:
            frame: o_cam, uint8 [M, 64, 64, 3].
            seen: what `look` says of them.
            proprio: o_pr, [M, P].
        """
        if self.bearings is None:
            return None
        with torch.autocast(seen.device.type, enabled=False):
            return self.bearings.read(frame, seen.float(), proprio)

    def progress(
        self, shown: Tensor | None, proprio: Tensor, instruction: Tensor, terminated: Tensor, track: Track,
        needles: tuple[Tensor, ...],
    ) -> Progress:  # fmt: skip
        """Return what is known of the way to where instructions lead.

        Args:
            shown: what `read` says of the frames, [B, T, K].
            proprio: o_pr, [B, T, P].
            instruction: A_{t-1}, int64 [B, T].
            terminated: beta_{t-1}, bool [B, T].
            track: before the first tick.
            needles: before the first tick.
        """
        if self.bearings is None or shown is None:
            return Progress(*self.odometry(proprio, instruction, terminated, track), needles)
        return follow(self.bearings, self.odometry, shown, proprio, instruction, terminated, track, *needles)

    def forward(
        self, seen: Tensor, progress: Tensor, proprio: Tensor, hidden: Tensor, cell: Tensor
    ) -> Verdicts:
        """Run over ticks of one instruction each, from the LSTM's given state.

        Args:
            seen: what `look` says of the frames, [B, T, S].
            progress: the features of `progress`, [B, T, ...].
            proprio: o_pr, [B, T, P].
            hidden: [B, L]; zeros when the instruction has just been issued.
            cell: [B, L]; likewise.
        """
        # The camera's word on where in its cell the robot is needs the heading, and must not copy the odometer.
        heading = torch.cat([progress[..., :2], torch.zeros_like(progress[..., 2:FEATURES])], dim=-1)
        camera = self.combine(self.see(seen) + self.turn(heading))
        inputs = torch.cat([camera.float(), progress, (proprio / _PROPRIO_SCALE).clamp(-3, 3)], dim=-1)
        with torch.autocast(inputs.device.type, enabled=False):
            outputs, (hidden, cell) = self.lstm(inputs, (hidden[None], cell[None]))
        logits = self.verdict(outputs)[..., 0].float()
        return Verdicts(logits, self.phases(camera).float(), hidden[0], cell[0])

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory of `batch` robots at the start of an episode."""
        track = self.odometry.initial(batch, self.device)
        return TerminationMemory(*self.initial_recurrence(batch), track, self.initial_needles(batch))

    @torch.inference_mode()
    def probability(self, inputs: TerminationInput, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return p(A_{t-1} is completed), [B], and the next memory.

        Raises:
            ValueError: if frames are not uint8 [B, 64, 64, 3] or proprioception is not finite.
        """
        check_frames(inputs.frame)
        if not np.isfinite(inputs.proprio).all():
            raise ValueError(f"proprioception {inputs.proprio.tolist()}: expected finite numbers")
        arrays, before = tick_arrays(inputs), parts_of(memory)
        if self.compiled is not None and len(inputs.frame) == 1:
            probability, *after = self.compiled([*arrays, *(part.numpy() for part in before)])
            parts = [torch.from_numpy(part) for part in after]
        else:
            output, *parts = self.tick(*(torch.from_numpy(x).to(self.device) for x in arrays), *before)
            probability = output.cpu().numpy()
        hidden, cell, *rest = parts
        track, needles = rest[: len(Track._fields)], rest[len(Track._fields) :]
        return probability, TerminationMemory(hidden, cell, Track(*track), tuple(needles))

    def tick(
        self, frame: Tensor, proprio: Tensor, instruction: Tensor, terminated: Tensor, hidden: Tensor, cell: Tensor,
        *parts: Tensor,
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
            parts: The parts of `Track`, and the needles if there are any.
        """
        track, needles = Track(*parts[: len(Track._fields)]), parts[len(Track._fields) :]
        seen, felt = self.look(self.encoder(frame)), proprio[:, None]
        shown = self.read(frame, seen, proprio)
        ahead = None if shown is None else shown[:, None]
        progress = self.progress(ahead, felt, instruction[:, None], terminated[:, None], track, needles)
        keep = (~terminated)[:, None].to(hidden.dtype)
        output = self(seen[:, None], progress.features, felt, hidden * keep, cell * keep)
        return (bounded_sigmoid(output.logits[:, 0]), output.hidden, output.cell, *progress.track, *progress.needles)


def parts_of(memory: Memory) -> list[Tensor]:
    """Return the parts of a `TerminationMemory` in the order in which `ControlTermination.tick` takes them."""
    hidden, cell, track, needles = memory
    return [hidden, cell, *track, *needles]
