"""One training step of state estimator and control termination together, on a shared ResNet (paper C.1, C.4).

Shapes: S streams, T ticks of a stretch, K = T / `update_every` frames that the estimator takes in, W windows of V
ticks, each within one instruction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import OFFSETS_XY
from mujoban_core.interfaces import renew_rows
from mujoban_estimator.data import Batch
from mujoban_estimator.estimator import Belief, EstimatorConfig, StateEstimator
from mujoban_estimator.losses import Views, estimator_loss, termination_loss
from mujoban_estimator.odometry import Track
from mujoban_estimator.termination import ControlTermination, TerminationConfig, true_phases


@dataclass(frozen=True)
class LearnerConfig:
    """What one training step consists of."""

    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    window_frames: int = 128
    """Frames of a step from which termination learns, beside those of the estimator."""
    window_length: int = 64
    """Most ticks of an instruction that it learns from."""
    unseen: float = 0.1
    """Weight of cells that were never in view."""
    frame: float = 2.0
    """Weight of the auxiliary loss on single frames."""
    place: float = 0.5
    """Weight of the auxiliary loss on the place within the cell."""
    cells: float = 0.1
    """Weight of the estimator's loss, a sum over cells, beside termination's."""
    slip: float = 0.05
    """Standard deviation of errors that the odometer starts with in training, in cells: what it drifts by in use."""
    lost: float = 0.1
    """Share of episodes in which the odometer starts anywhere, so that the camera is not ignored."""

    def __post_init__(self) -> None:
        """Reject configurations that contradict themselves."""
        shared = ("body", "stem", "channels", "blocks")
        differing = [n for n in shared if getattr(self.estimator, n) != getattr(self.termination, n)]
        if differing:
            raise ValueError(f"estimator and termination differ in {', '.join(differing)}: expected one shared ResNet")
        for name in ("window_frames", "window_length"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: expected at least 1")


class Windows(NamedTuple):
    """Stretches of ticks that each belong to one instruction and begin when it is issued."""

    stream: NDArray[np.int64]
    """[W]."""
    tick: NDArray[np.int64]
    """Ticks within the batch, padded by repeating the last, [W, V]."""
    valid: NDArray[np.bool_]
    """[W, V]."""


def choose_windows(batch: Batch, frames: int, length: int, rng: np.random.Generator) -> Windows:
    """Draw instructions that begin within a batch until their ticks number `frames`.

    Args:
        batch: the batch.
        frames: about how many ticks to take.
        length: most ticks of one instruction.
        rng: source of the choice.
    """
    starts = batch.terminated & batch.valid
    starts[:, 0] |= batch.first
    ends = batch.valid.sum(axis=1)
    stream, tick = np.nonzero(starts)
    following = np.append(tick[1:], 0)
    same = np.append(stream[1:] == stream[:-1], False)
    count = np.minimum(np.where(same, following, ends[stream]) - tick, length)
    order = rng.permutation(len(stream))
    chosen = order[np.cumsum(count[order]) - count[order] < frames]
    steps = np.arange(count[chosen].max(initial=1))
    ticks = tick[chosen, None] + np.minimum(steps, count[chosen, None] - 1)
    return Windows(stream[chosen], ticks, steps < count[chosen, None])


class Learner:
    """Holds both modules, what they remember of each stream, and computes the loss of a batch."""

    def __init__(self, config: LearnerConfig, streams: int, rng: np.random.Generator, device: str = "cpu") -> None:
        """Make both modules on one shared ResNet, for batches of `streams` streams."""
        self.config = config
        self.device = torch.device(device)
        self.rng = rng
        estimator = vars(config.estimator)
        self.estimator = StateEstimator(**estimator).to(self.device)
        self.termination = ControlTermination(self.estimator.encoder, **vars(config.termination)).to(self.device)
        self._belief = self.estimator.initial_belief(streams)
        self._track = self._lost_track(streams)

    def parameters(self) -> list[torch.nn.Parameter]:
        """Return the parameters of both modules, shared ones once."""
        both = {id(p): p for module in (self.estimator, self.termination) for p in module.parameters()}
        return list(both.values())

    def _lost_track(self, streams: int) -> Track:
        """Return tracks at the start of episodes whose odometers are off."""
        error = self.rng.normal(0.0, self.config.slip, (streams, 2))
        anywhere = self.rng.uniform(-0.5, 0.5, (streams, 2))
        error = np.where(self.rng.random((streams, 1)) < self.config.lost, anywhere, error)
        position = torch.from_numpy(error.astype(np.float32)).to(self.device)
        return self.termination.odometry.initial(streams, self.device)._replace(position=position)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a batch and its parts; the batch continues the one before."""
        streams, ticks = batch.valid.shape
        self._belief = renew_rows(self._belief, self.estimator.initial_belief(streams), batch.first)
        self._track = renew_rows(self._track, self._lost_track(streams), batch.first)
        updates = np.arange(0, ticks, self.config.estimator.update_every)
        windows = choose_windows(batch, self.config.window_frames, self.config.window_length, self.rng)
        seen = (np.arange(streams)[:, None] * ticks + updates).ravel()
        felt = (windows.stream[:, None] * ticks + windows.tick).ravel()
        # Frames that both look at are encoded once.
        frames, place = np.unique(np.concatenate([seen, felt]), return_inverse=True)
        with torch.autocast(self.device.type, torch.bfloat16):
            encoded = self.estimator.encoder(self._tensor(batch.frame.reshape(-1, *batch.frame.shape[2:])[frames]))
            features = encoded[torch.from_numpy(place).to(self.device)]
            mapped, parts = self._estimator_loss(features[: len(seen)], batch, updates)
            ended, more = self._termination_loss(features[len(seen) :], batch, windows)
        return self.config.cells * mapped + ended, {**parts, **more}

    def _estimator_loss(
        self, features: Tensor, batch: Batch, updates: NDArray[np.int64]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        streams = len(batch.valid)
        output = self.estimator(features.unflatten(0, (streams, -1)), batch.pose[:, updates], self._belief)
        # Truncated back-propagation through time: the belief goes on, its gradient does not.
        self._belief = Belief(*(b.detach() for b in output.belief))
        views = Views(self._tensor(batch.in_view[:, updates]), self._tensor(batch.seen[:, updates]))
        return estimator_loss(
            output, self._tensor(batch.abstract_state[:, updates]), views,
            self._tensor(batch.valid[:, updates]).float(), unseen=self.config.unseen, frame=self.config.frame,
        )  # fmt: skip

    def _termination_loss(
        self, features: Tensor, batch: Batch, windows: Windows
    ) -> tuple[Tensor, dict[str, Tensor]]:
        instruction, proprio = self._tensor(batch.instruction), self._tensor(batch.proprio)
        terminated = self._tensor(batch.terminated)
        progress, self._track = self.termination.odometry(proprio, instruction, terminated, self._track)
        at = (windows.stream[:, None], windows.tick)
        hidden, cell = self.termination.initial_recurrence(len(windows.stream))
        output = self.termination(features.unflatten(0, windows.tick.shape), progress[at], proprio[at], hidden, cell)
        direction = self._tensor(OFFSETS_XY[batch.instruction[at]].astype(np.float32))
        phases = true_phases(self._tensor(batch.pose[at]), direction, self.termination.odometry.cell_size)
        return termination_loss(
            output.logits, output.phases, self._tensor(batch.completed[at]), phases,
            self._tensor(windows.valid).float(), place=self.config.place,
        )  # fmt: skip

    def _tensor(self, values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(self.device)
