"""Batches of lessons for imitation: demonstrations and corrections, kept, drawn, and shown as they are seen.

Shapes: B batch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from mujoban_planner.lessons import LessonMaker, LessonProcess
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.samples import Batch, SampleBuffer, Samples, concatenate, make_batch
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.uncertainty import blur, hide_unseen
from mujoban_planner.validation import Shares, difficulty_shares
from mujoban_rl.engine import Source, State
from mujoban_rl.weights import save_weights

_STOCK_BATCHES: Final = 800
"""Batches of demonstrations kept ahead, and learned from before the planner's own play is worth correcting."""
_ENOUGH: Final = 20_000
"""Corrections from which on they make up their whole share of a batch."""
_HANDED_OVER: Final = 500
"""Updates after which a process beside plays with newer weights."""
_BITS: Final = 1000
"""Streams of levels that one seed may use up, one for each bit of a run with a process beside."""


@dataclass(frozen=True)
class LessonConfig:
    """What defines the lessons of a run."""

    batch_size: int = 128
    corrections: float = 0.5
    """Share of a batch that corrects the planner's own play (DAgger), once there is some."""
    judged: float = 1.0
    """Share of the arrangements of boxes in demonstrations in which every possible push is judged."""
    freshness: float = 0.4
    """New samples, of demonstrations and of corrections each, per sample that is learned from."""
    noise: float = 0.1
    """Share of a batch whose abstract states are blurred, as estimates are."""
    hidden: float = 0.4
    """Share of a batch that shows only what the robot may have seen so far."""
    mix: Shares = (0.03, 0.04, 0.06, 0.12, 0.75)
    """Shares of difficulties 1 to 5 among the training levels."""
    buffer: int = 2_000_000
    """Samples kept of demonstrations, and as many of corrections."""
    seed: int = 0


class _Workshop(ABC):
    """Where lessons are made."""

    @abstractmethod
    def demonstrations(self, *, wait: bool) -> Samples | None:
        """Return new demonstrations; None where there are none yet and nobody waits."""

    @abstractmethod
    def corrections(self) -> Samples | None:
        """Return new corrections, or None where there are none yet."""

    @abstractmethod
    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Correct the play of a planner with these weights."""

    @property
    @abstractmethod
    def cpu_seconds(self) -> float:
        """CPU time of a process beside."""

    def close(self) -> None:  # noqa: B027 - only a process is ended
        """End what runs beside."""


class _Inside(_Workshop):
    """Makes lessons in this process, between the steps: the same for the same seed."""

    def __init__(self, config: LessonConfig, player: LearnedPlanner) -> None:
        self.maker = LessonMaker(_BITS * config.seed, difficulty_shares(config.mix), config.judged)
        self._player = player

    def demonstrations(self, *, wait: bool) -> Samples:
        return self.maker.demonstrations()

    def corrections(self) -> Samples:
        return self.maker.corrections(self._player)

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        self._player.load_state_dict(weights)

    @property
    def cpu_seconds(self) -> float:
        return 0.0


class _Beside(_Workshop):
    """Takes lessons from a process beside, whenever they are ready."""

    def __init__(self, config: LessonConfig, player: LearnedPlanner, played: Path, bit: int) -> None:
        stream = _BITS * config.seed + bit
        self._process = LessonProcess(stream, difficulty_shares(config.mix), config.judged, played, niceness=1)
        self._player, self._played, self._version = player, played, -_HANDED_OVER

    def demonstrations(self, *, wait: bool) -> Samples | None:
        return self._process.take(self._process.demonstrations, wait=wait)

    def corrections(self) -> Samples | None:
        return self._process.take(self._process.corrections, wait=False)

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        if version and version - self._version >= _HANDED_OVER:
            self._version = version
            self._player.load_state_dict(weights)
            save_weights(self._played, self._player, self._player.config, {"updates": version})

    @property
    def cpu_seconds(self) -> float:
        return self._process.cpu_seconds

    def close(self) -> None:
        self._process.close()


class LessonSource(Source[Batch]):
    """Batches of lessons, half of them corrections, under random symmetries, blurred and with cells hidden.

    Lessons that are made inside are part of a checkpoint, so that a run goes on to the bit. With a process beside,
    which makes them at its own pace, a run that goes on draws fresh levels into empty buffers.
    """

    def __init__(self, config: LessonConfig, player: LearnedPlanner, beside: Path | None = None) -> None:
        """Start without lessons.

        Args:
            config: What defines them.
            player: Planner whose play is corrected; gets the published weights, and is not shared with the learner.
            beside: Weights file through which the planner goes to a process of its own; None makes lessons inside.
        """
        self._config, self._player, self._beside = config, player.eval(), beside
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._demonstrations, self._corrections = SampleBuffer(config.buffer), SampleBuffer(config.buffer)
        self._inside = None if beside is not None else _Inside(config, player)
        self._workshop: _Workshop | None = self._inside
        self._bit = 0
        self._from: int | None = 0 if beside is None else None
        """Samples learned from before the buffers were filled."""

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Correct the play of a planner with these weights from now on."""
        self._open().publish(weights, version)

    def next_batch(self) -> Batch:
        """Return B samples, as the planner will see them."""
        self._collect()
        config = self._config
        # A few corrections must not be learned by heart.
        corrections = int(config.batch_size * config.corrections * min(1.0, self._corrections.size / _ENOUGH))
        parts = [self._demonstrations.draw(config.batch_size - corrections, self._rng)]
        if corrections:
            parts.append(self._corrections.draw(corrections, self._rng))
        batch = make_batch(concatenate(parts), self._rng.integers(0, SYMMETRIES, config.batch_size))
        order = torch.randperm(config.batch_size, generator=self._generator)
        batch = Batch._make(x[order] for x in batch)
        state = blur(batch.state, config.noise, self._generator)
        self.samples += config.batch_size
        return batch._replace(state=hide_unseen(state, config.hidden, self._rng))

    def _open(self) -> _Workshop:
        if self._workshop is None:
            assert self._beside is not None
            self._workshop = _Beside(self._config, self._player, self._beside, self._bit)
        return self._workshop

    def _collect(self) -> None:
        """Fetch lessons where the buffers lag behind what was learned from."""
        config, workshop = self._config, self._open()
        if self._from is None:
            self._from = self.samples
        learned, stock = self.samples - self._from, _STOCK_BATCHES * config.batch_size
        if self._demonstrations.added < stock + config.freshness * learned:
            new = workshop.demonstrations(wait=self._demonstrations.size == 0)
            if new is not None:
                self._demonstrations.add(new)
        if self.samples > stock and self._corrections.added < _ENOUGH + config.freshness * learned:
            new = workshop.corrections()
            if new is not None:
                self._corrections.add(new)

    def statistics(self) -> dict[str, float]:
        """Return how many lessons there were."""
        added = {"demonstrations": self._demonstrations.added, "corrections": self._corrections.added}
        return {name: float(n) for name, n in added.items()}

    def state(self) -> State:
        """Return random states and, where they are made inside, all lessons and what their maker remembers."""
        values = {"rng": self._rng.bit_generator.state, "bit": self._bit, "from": self._from}
        own = State(values, {"generator": self._generator.get_state()})
        if self._inside is None:
            return State.of({"own": own})
        parts = {"demonstrations": self._demonstrations, "corrections": self._corrections, "maker": self._inside.maker}
        return State.of({"own": own} | {name: part.state() for name, part in parts.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        self._bit = own.values["bit"] + (self._inside is None)
        self._from = None
        if self._inside is not None and "maker" in state.values:
            self._from = own.values["from"]
            for name, part in (
                ("demonstrations", self._demonstrations),
                ("corrections", self._corrections),
                ("maker", self._inside.maker),
            ):
                part.restore(state.part(name))

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of the process beside."""
        return 0.0 if self._workshop is None else self._workshop.cpu_seconds

    def close(self) -> None:
        """End the process beside."""
        if self._workshop is not None:
            self._workshop.close()
