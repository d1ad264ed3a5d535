"""One training step of state estimator and control termination together, on a shared ResNet (paper C.1, C.4).

Shapes: S streams, T ticks of a stretch, K = T / `update_every` frames that the estimator takes in.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_core.grid import INSTRUCTION_AXES
from mujoban_core.interfaces import renew_rows
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_estimator.data import Batch, Windows, choose_windows
from mujoban_estimator.estimator import Belief, EstimatorConfig, StateEstimator
from mujoban_estimator.evaluate import evaluate
from mujoban_estimator.losses import Views, estimator_loss, termination_loss
from mujoban_estimator.odometry import Track
from mujoban_estimator.termination import ControlTermination, TerminationConfig
from mujoban_rl.best import JudgedLearner
from mujoban_rl.engine import State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, step_if_finite, warm_up_linear
from mujoban_rl.precision import autocast
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.sight.place import phases, phases_along
from mujoban_rl.weights import WeightsError, load_weights, save_weights, usable_device

_PLACE_OFF: Final = 0.02
"""Standard deviation of what needles of the place are off in use, in cells."""
_HEADING_OFF: Final = math.radians(2.0)
"""The same of those of the heading."""
JUDGED_BY: Final = ("boxes_all_right_if_seen", "termination_on_time")
"""Rates that tell which modules of a run are best, in this order: wrong estimates are what loses levels."""


@dataclass(frozen=True)
class LearnerConfig:
    """What one training step consists of."""

    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    window_frames: int = 40
    """Frames of a step from which termination learns, beside those of the estimator, which has more to learn."""
    window_length: int = 64
    """Most ticks of an instruction that it learns from."""
    unseen: float = 0.1
    """Weight of cells that were never in view."""
    frame: float = 2.0
    """Weight of the auxiliary loss on single frames."""
    place: float = 0.5
    """Weight of the auxiliary loss on the place within the cell."""
    bearings: float = 0.5
    """Weight of that on what frames show of heading and place, for a body that does not feel its heading."""
    cells: float = 0.1
    """Weight of the estimator's loss, a sum over cells, beside termination's."""
    slip: float = 0.015
    """Standard deviation of errors that the odometer starts with in training, in cells: what it drifts by in use."""
    lost: float = 0.05
    """Share of episodes in which the odometer starts anywhere, so that the camera is not ignored."""

    def __post_init__(self) -> None:
        """Reject configurations that contradict themselves."""
        shared = ("body", "stem", "channels", "blocks")
        if names := ", ".join(n for n in shared if getattr(self.estimator, n) != getattr(self.termination, n)):
            raise ValueError(f"--learner.estimator and --learner.termination differ in {names}: expected one ResNet")
        check_counts(self, "window_frames", "window_length")
        check_not_negative(self, "unseen", "frame", "place", "bearings", "cells", "slip")
        check_shares(self, "lost")


@dataclass(frozen=True)
class TrainConfig:
    """What must not change between the bits of a run."""

    learner: LearnerConfig = field(default_factory=LearnerConfig)
    streams: int = 4
    """Bags that are read side by side; each is a row of the batch, whose memory goes on from step to step."""
    length: int = 64
    """Ticks of a stretch, a multiple of `update_every`."""
    shards: int = 1
    """Parts of a batch whose gradients are computed side by side, each by a thread, and averaged."""
    steps: int = 20_000
    """Most steps of the run."""
    cpu_seconds: float = 1e9
    """CPU seconds of training at which the run is complete, if its steps have not come first."""
    horizon_seconds: float = 1e9
    """Likewise of wall-clock seconds, for a GPU; evaluations are left out."""
    learning_rate: float = 1.5e-3
    """Largest learning rate."""
    warm_up: float = 0.0025
    """Share of the budget, of steps or seconds, within which the learning rate rises from 0."""
    final_rate: float = 0.03
    """Learning rate at the end of the budget, as a share of `learning_rate`; it falls linearly."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject what contradicts itself."""
        every = self.learner.estimator.update_every
        if self.length < 1 or self.length % every:
            raise ValueError(f"length is {self.length}: expected a multiple of update_every, {every}")
        check_counts(self, "streams", "steps")
        check_positive(self, "cpu_seconds", "horizon_seconds", "learning_rate", "clip")
        if not 1 <= self.shards <= self.streams:
            raise ValueError(f"{self.shards} shards of {self.streams} streams: expected 1 to {self.streams}")
        check_shares(self, "warm_up", "final_rate")


def _learned_for(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return what weights depend on: all but how beta follows from its probability."""
    return {k: v for k, v in hyperparameters.items() if k not in ("limit", "sample", "threshold")}


class _Shard(NamedTuple):
    """Some streams of a batch, and what is remembered of them before it."""

    batch: Batch
    windows: Windows
    belief: Belief
    track: Track
    off: NDArray[np.float32]
    """By how much needles are off when an instruction begins, in standard deviations, [W, 3]."""


class _Learned(NamedTuple):
    """What a shard says."""

    loss: Tensor
    parts: dict[str, Tensor]
    gradients: tuple[Tensor | None, ...]
    belief: Belief
    track: Track


class EstimatorLearner(JudgedLearner[Batch]):
    """Trains both modules, with what they remember of each stream; a batch continues the one before.

    Those that are right on most frames of the validation bags are exported: bags of few episodes are soon known by
    heart, which makes what has learned from many worse.
    """

    def __init__(
        self, config: TrainConfig, *, device: str = "cpu", validation: Sequence[Path] = (), skip_damaged: bool = False,
        out: Path | None = None,
    ) -> None:  # fmt: skip
        """Make both modules on one shared ResNet.

        Args:
            config: Settings; the seed decides weights and every draw.
            device: Where the modules learn.
            validation: Bags to evaluate on; none: no evaluation.
            skip_damaged: Leave damaged parts of these out instead of refusing them.
            out: Folder that receives the weights of both modules; None: `weights` in the run's directory.
        """
        super().__init__()
        self.training, self.config = config, config.learner
        self.device = usable_device(device)
        self.rng = np.random.default_rng(config.seed)
        torch.manual_seed(config.seed)  # the initial weights
        self.estimator = StateEstimator(**vars(self.config.estimator)).to(self.device)
        self.termination = ControlTermination(self.estimator.encoder, **vars(self.config.termination)).to(self.device)
        self._parameters = list({id(p): p for module in self.modules.values() for p in module.parameters()}.values())
        self.optimiser = torch.optim.Adam(self._parameters, config.learning_rate, fused=True)
        self._schedule = ProgressSchedule(self.optimiser, warm_up_linear(config.warm_up, config.final_rate))
        self._threads = ThreadPoolExecutor(config.shards, "shard", torch.set_num_threads, (torch.get_num_threads(),))
        self._validation, self._skip_damaged, self._out = list(validation), skip_damaged, out
        self._belief = self.estimator.initial_belief(config.streams)
        self._track = self._lost_track(config.streams)
        self._begun = np.zeros(config.streams, np.bool_)
        """Streams in which an episode began in a batch that was refused, so that they have the memory of another."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Both modules; the ResNet is part of either."""
        return {"estimator": self.estimator, "termination": self.termination}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """One for all."""
        return {"adam": self.optimiser}

    def start_from(self, folder: Path) -> None:
        """Begin with the weights of former modules; the ResNet is the estimator's.

        Modules of another body lend what does not depend on the body: all layers of the same name and shape.

        Raises:
            WeightsError: If a file is missing or damaged, or of another configuration.
        """
        for name, module in (("termination", self.termination), ("estimator", self.estimator)):
            path = folder / f"{name}.safetensors"
            trained = load_weights(type(module), path)
            theirs, ours = (_learned_for(m.hyperparameters()) for m in (trained, module))
            if theirs | {"body": ours["body"]} != ours:
                raise WeightsError(f"{path}: weights of {theirs}, expected those of {ours}")
            own, same_body = module.state_dict(), theirs == ours
            fitting = {k: v for k, v in trained.state_dict().items() if k in own and v.shape == own[k].shape}
            module.load_state_dict(trained.state_dict() if same_body else fitting, strict=same_body)

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step; return the parts of the loss."""
        self._schedule.follow(progress)
        learned = self._learn(batch)
        loss = torch.stack([one.loss for one in learned]).mean()
        for parameter, *gradients in zip(self._parameters, *(one.gradients for one in learned), strict=True):
            parameter.grad = _mean(parameter, [g for g in gradients if g is not None], len(learned))
        taken = step_if_finite(loss, [self.optimiser], guard, clip=self.training.clip) is not None
        self._begun = np.zeros_like(batch.first) if taken else self._begun | batch.first
        if taken:
            # What a refused batch left in memory would spoil those to come.
            self._belief = Belief(*(torch.cat(rows) for rows in zip(*(one.belief for one in learned), strict=True)))
            self._track = Track(*(torch.cat(rows) for rows in zip(*(one.track for one in learned), strict=True)))
        parts = {name: [one.parts[name].item() for one in learned] for name in learned[0].parts}
        return {f"train/{name}": float(np.mean(values)) for name, values in [("loss", loss.item()), *parts.items()]}

    def own_state(self) -> State:
        """Return the random state and what the modules remember of each stream."""
        tensors = {f"belief.{k}": v for k, v in self._belief._asdict().items()}
        tensors |= {f"track.{k}": v for k, v in self._track._asdict().items()}
        return State({"rng": self.rng.bit_generator.state, "begun": self._begun.tolist()}, tensors)

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self.rng.bit_generator.state = state.values["rng"]
        tensors = {k: v.to(self.device) for k, v in state.tensors.items()}
        self._belief = Belief(*(tensors[f"belief.{k}"] for k in Belief._fields))
        self._track = Track(*(tensors[f"track.{k}"] for k in Track._fields))
        # Runs that began before this was noted have none.
        self._begun = np.array(state.values.get("begun", self._begun), np.bool_)

    def evaluate(self) -> dict[str, float]:
        """Return the rates of both modules on the validation bags; keep the two if these make them the best."""
        if not self._validation:
            return {}
        found = evaluate(self.estimator, self.termination, self._validation, skip_damaged=self._skip_damaged)
        # A rate of nothing is not a number, which is no better than any.
        rates = {name: rate for name, rate in found.items() if math.isfinite(rate)}
        self.best.judge(self._both, tuple(rates.get(name, 0.0) for name in JUDGED_BY), rates)
        return rates

    def folder(self, directory: RunDirectory) -> Path:
        """Return where the weights of both modules go."""
        return self._out or directory.path / "weights"

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the weights of the best two modules, or of the present ones where none were judged."""
        out = self.folder(directory)
        best, told = self.best.chosen(self._both), {**record, **self.best.told}
        for name, module in (("estimator", self.estimator), ("termination", self.termination)):
            save_weights(out / f"{name}.safetensors", best[name], module.hyperparameters(), told)

    @property
    def _both(self) -> nn.ModuleDict:
        """Both modules as one, since they share a ResNet."""
        return nn.ModuleDict(self.modules)

    def _lost_track(self, streams: int) -> Track:
        """Return tracks at the start of episodes whose odometers are off."""
        error = self.rng.normal(0.0, self.config.slip, (streams, 2))
        anywhere = self.rng.uniform(-0.5, 0.5, (streams, 2))
        error = np.where(self.rng.random((streams, 1)) < self.config.lost, anywhere, error)
        position = torch.from_numpy(error.astype(np.float32)).to(self.device)
        return self.termination.odometry.initial(streams, self.device)._replace(position=position)

    def _learn(self, batch: Batch) -> list[_Learned]:
        """Return loss and gradients of each shard, in their order."""
        shards = list(self._shards(batch))
        compute = map if len(shards) == 1 else self._threads.map
        return list(compute(self._gradients, shards))

    def _shards(self, batch: Batch) -> Iterator[_Shard]:
        """Divide the streams; all that is drawn by chance is drawn here, so that threads draw nothing."""
        streams, count = len(batch.valid), self.training.shards
        fresh = batch.first | self._begun
        belief = renew_rows(self._belief, self.estimator.initial_belief(streams), fresh)
        track = renew_rows(self._track, self._lost_track(streams), fresh)
        frames = -(-self.config.window_frames // count)
        # Slices, whose frames are not copied.
        bounds = np.cumsum([0, *map(len, np.array_split(np.arange(streams), count))]).tolist()
        for rows in (slice(*both) for both in pairwise(bounds)):
            part = Batch._make(values[rows] for values in batch)
            windows = choose_windows(part, frames, self.config.window_length, self.rng)
            kept = 0 if self.termination.bearings is None else len(windows.stream)
            off = self.rng.normal(size=(kept, 3)).astype(np.float32)
            yield _Shard(part, windows, Belief(*(b[rows] for b in belief)), Track(*(t[rows] for t in track)), off)

    def _gradients(self, shard: _Shard) -> _Learned:
        learned = self._loss(shard)
        gradients = torch.autograd.grad(learned.loss, self._parameters, allow_unused=True)
        return learned._replace(loss=learned.loss.detach(), gradients=gradients)

    def _loss(self, shard: _Shard) -> _Learned:
        """Return the loss of a shard, its parts and what is remembered after it; no gradients yet."""
        batch, windows = shard.batch, shard.windows
        streams, ticks = batch.valid.shape
        updates = np.arange(0, ticks, self.config.estimator.update_every)
        seen = (np.arange(streams)[:, None] * ticks + updates).ravel()
        felt = (windows.stream[:, None] * ticks + windows.tick).ravel()
        # Frames that both look at are encoded once.
        frames, place = np.unique(np.concatenate([seen, felt]), return_inverse=True)
        images = self._tensor(batch.frame.reshape(-1, *batch.frame.shape[2:])[frames])
        with autocast(self.device):
            encoded = self.estimator.encoder(images)
            features = encoded[torch.from_numpy(place[: len(seen)]).to(self.device)]
            mapped, parts, belief = self._estimator_loss(features, shard, updates)
            looked = self.termination.look(encoded)
            shown, told = self._bearings_loss(images, looked, batch, frames)
            at = torch.from_numpy(place[len(seen) :].reshape(windows.tick.shape)).to(self.device)
            ended, more, track = self._termination_loss(looked[at], None if shown is None else shown[at], shard)
        loss = self.config.cells * mapped + ended + self.config.bearings * told
        return _Learned(loss, {**parts, **more, "bearings": told.detach()}, (), belief, track)

    def _estimator_loss(
        self, features: Tensor, shard: _Shard, updates: NDArray[np.int64]
    ) -> tuple[Tensor, dict[str, Tensor], Belief]:
        batch = shard.batch
        output = self.estimator(features.unflatten(0, (len(batch.valid), -1)), batch.pose[:, updates], shard.belief)
        # Truncated back-propagation through time: the belief goes on, its gradient does not.
        # In the layout that a checkpoint restores, by which convolutions choose their order of additions.
        belief = Belief(*(b.detach().contiguous() for b in output.belief))
        views = Views(self._tensor(batch.in_view[:, updates]), self._tensor(batch.seen[:, updates]))
        loss, parts = estimator_loss(
            output, self._tensor(batch.abstract_state[:, updates]), views,
            self._tensor(batch.valid[:, updates]).float(), unseen=self.config.unseen, frame=self.config.frame,
        )  # fmt: skip
        return loss, parts, belief

    def _bearings_loss(
        self, images: Tensor, looked: Tensor, batch: Batch, frames: NDArray[np.int64]
    ) -> tuple[Tensor | None, Tensor]:
        """Return what frames with these numbers in a batch show of heading and place, and how far it is off."""
        if self.termination.bearings is None:
            return None, images.new_zeros((), dtype=torch.float32)
        proprio, pose = (self._tensor(x.reshape(-1, x.shape[-1])[frames]) for x in (batch.proprio, batch.pose))
        shown = self.termination.read(images, looked, proprio)
        assert shown is not None
        return shown, self.termination.bearings.loss(shown, pose)

    def _termination_loss(
        self, looked: Tensor, shown: Tensor | None, shard: _Shard
    ) -> tuple[Tensor, dict[str, Tensor], Track]:
        batch, windows = shard.batch, shard.windows
        at = (windows.stream[:, None], windows.tick)
        first = (windows.stream, windows.tick[:, 0])
        proprio, instruction = self._tensor(batch.proprio), self._tensor(batch.instruction)
        terminated = self._tensor(batch.terminated)
        heading = None if shown is None else self._tensor(batch.pose[..., 2])
        tracks = self.termination.odometry.follow(proprio, instruction, terminated, shard.track, heading)
        both = zip(shard.track, tracks, strict=True)
        before = Track(*(torch.cat([start[:, None], after[:, :-1]], 1)[first] for start, after in both))
        needles = self._needles(shard)
        progress = self.termination.progress(shown, proprio[at], instruction[at], terminated[at], before, needles)
        recurrence = self.termination.initial_recurrence(len(windows.stream))
        output = self.termination(looked, progress.features, proprio[at], *recurrence)
        axis = self._tensor(INSTRUCTION_AXES[batch.instruction[at]].astype(np.float32))
        place = phases(self._tensor(batch.pose[at]), self.termination.odometry.body.cell_size)
        loss, parts = termination_loss(
            output.logits, output.phases, self._tensor(batch.completed[at]), phases_along(place, axis),
            self._tensor(windows.valid).float(), place=self.config.place,
        )  # fmt: skip
        return loss, parts, tracks.after()

    def _needles(self, shard: _Shard) -> tuple[Tensor, ...]:
        """Return needles as they may stand when an instruction begins: nearly right, or at an episode's start zero."""
        bearings, (batch, windows) = self.termination.bearings, shard[:2]
        if bearings is None:
            return ()
        first = windows.tick[:, 0]
        cell = self.termination.odometry.body.cell_size
        off = shard.off * np.array([_PLACE_OFF * cell, _PLACE_OFF * cell, _HEADING_OFF], np.float32)
        needles = bearings.pointing(self._tensor(batch.pose[windows.stream, first] + off))
        begins = self._tensor(batch.first[windows.stream] & (first == 0))
        return (torch.where(begins[:, None], torch.zeros_like(needles), needles),)

    def _tensor(self, values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(self.device)


def _mean(parameter: Tensor, gradients: Sequence[Tensor], count: int) -> Tensor | None:
    """Return a parameter's mean gradient over `count` shards; those that it has no part in count as zeros.

    It lies in memory as the parameter does: Adam's one kernel takes it as it lies, or refuses it on a GPU.
    """
    if not gradients:
        return None
    total = torch.empty_like(parameter).copy_(gradients[0])
    for gradient in gradients[1:]:
        total += gradient
    return total / count
