"""Batches of lessons for imitation: demonstrations and corrections, kept, drawn, and shown as they are seen.

Actors make the lessons (`mujoban_rl.actors`), as many as are due, so that a run with a process beside is repeatable.

Shapes: B batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from mujoban_core.ranges import check_counts, check_positive, check_shares
from mujoban_planner.lessons import LessonMaker
from mujoban_planner.samples import Batch, SampleBuffer, Samples, concatenate, make_batch
from mujoban_planner.seed_streams import LESSONS, check_seed, stream_number
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.uncertainty import Uncertainty, UncertaintyConfig
from mujoban_planner.validation import NetworkConfig, Shares, check_mix, difficulty_shares
from mujoban_rl.actors import Actor, ActorPool, Experience
from mujoban_rl.engine import Source, State

_KINDS: Final = ("demonstrations", "corrections")


@dataclass(frozen=True)
class LessonConfig(UncertaintyConfig):
    """What defines the lessons of a run."""

    batch_size: int = 128
    """States of an update."""
    corrections: float = 0.5
    """Share of a batch that corrects the planner's own play (DAgger), once there is some."""
    judged: float = 1.0
    """Share of the arrangements of boxes in demonstrations in which every possible push is judged."""
    freshness: float = 0.4
    """New samples, of demonstrations and of corrections each, per sample that is learned from."""
    noise: float = 0.1
    hidden: float = 0.4
    mix: Shares = (0.03, 0.04, 0.06, 0.12, 0.75)
    """Shares of difficulties 1 to 5 among the training levels."""
    long: float = 0.0
    """Share of the levels of difficulty 5 whose solution takes `long_moves` at least."""
    long_moves: int = 45
    """Of all levels of difficulty 5 one in eight takes so many."""
    levels: int = 256
    """Fresh levels of a lesson; the planner plays half as many before it is corrected."""
    stock: int = 800
    """Batches of demonstrations kept ahead, and learned from before the planner's own play is worth correcting."""
    enough: int = 20_000
    """Corrections from which on they make up their whole share of a batch."""
    buffer: int = 2_000_000
    """Samples kept of demonstrations, and as many of corrections."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject lessons of nothing, and what is no share."""
        super().__post_init__()
        check_counts(self, "batch_size", "long_moves", "levels", "stock", "enough", "buffer")
        check_seed(self.seed, LESSONS)
        check_shares(self, "corrections", "judged", "long")
        check_positive(self, "freshness")
        check_mix(self.mix)


class LessonActor(Actor):
    """Makes lessons: demonstrations at first, then corrections of the planner's play by turns with them.

    Delivered are the columns of `Samples` of one lesson, under `demonstrations.` or `corrections.`; a step is a sample.
    """

    def __init__(self, config: LessonConfig, network: NetworkConfig, stream: int, *, device: str = "cpu") -> None:
        """Start without a lesson.

        Args:
            config: What defines the lessons.
            network: What to build for the weights whose play is corrected.
            stream: Of levels and randomness.
            device: Of that network.
        """
        self._config, self._planner = config, network.build().eval().to(device)
        self._planner.lay_out()
        mix = difficulty_shares(config.mix)
        self._maker = LessonMaker(
            stream_number(config.seed, stream), mix, config.judged, long=config.long, long_moves=config.long_moves
        )
        self._version = 0
        self._ahead = 0  # demonstrations less corrections, since there are any of these

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Correct the play of a planner with these weights."""
        self._planner.load_state_dict(weights)
        self._version = version

    def act(self) -> Experience:
        """Make a lesson."""
        config, correctable = self._config, self._version > self._config.stock
        correct = correctable and self._ahead >= 0
        if correct:
            lesson = self._maker.corrections(self._planner, max(config.levels // 2, 1))
        else:
            lesson = self._maker.demonstrations(config.levels)
        n = len(lesson.agent)
        self._ahead += correctable * (-n if correct else n)
        return Experience({f"{_KINDS[correct]}.{name}": column for name, column in lesson._asdict().items()}, n)

    def state(self) -> State:
        """Return all that changes but the weights."""
        return State.of({"own": State({"ahead": self._ahead}), "maker": self._maker.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._ahead = state.part("own").values["ahead"]
        self._maker.restore(state.part("maker"))


class LessonSource(Source[Batch]):
    """Batches of lessons, half of them corrections, under random symmetries, blurred and with cells hidden.

    Each batch waits for the lesson that is due for it, so that old ones are not learned by heart where the learner is
    faster than those who make lessons.
    """

    def __init__(self, config: LessonConfig, pool: ActorPool) -> None:
        """Start without lessons.

        Args:
            config: What defines them.
            pool: Its `LessonActor`s make them.
        """
        self._config, self._pool = config, pool
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator().manual_seed(config.seed)
        self._uncertainty = Uncertainty(config)
        self._buffers = {kind: SampleBuffer(config.buffer) for kind in _KINDS}

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Correct the play of a planner with these weights in lessons that are begun from now on."""
        self._pool.publish(weights, version)

    def next_batch(self) -> Batch:
        """Return B samples, as the planner will see them."""
        config, (demonstrations, corrections) = self._config, self._buffers.values()
        if demonstrations.added + corrections.added < self._due():
            self._add(self._pool.collect())
        # A planner that has learned is corrected first, where its run begins anew.
        while not demonstrations.added:
            self._add(self._pool.collect())
        # A few corrections must not be learned by heart.
        corrected = int(config.batch_size * config.corrections * min(1.0, corrections.size / config.enough))
        parts = [demonstrations.draw(config.batch_size - corrected, self._rng)]
        if corrected:
            parts.append(corrections.draw(corrected, self._rng))
        batch = make_batch(concatenate(parts), self._rng.integers(0, SYMMETRIES, config.batch_size))
        order = torch.randperm(config.batch_size, generator=self._generator)
        batch = Batch._make(x[order] for x in batch)
        self.samples += config.batch_size
        return batch._replace(state=self._uncertainty.apply(batch.state, self._generator, self._rng))

    def _due(self) -> float:
        """Return how many samples the lessons must have had; what is missing comes in lesson by lesson."""
        config, samples = self._config, self.samples - self.began
        stock, fresh = config.stock * config.batch_size, config.freshness * samples
        return stock + fresh if samples <= stock else stock + config.enough + 2.0 * fresh

    def _add(self, lesson: Experience) -> None:
        kind = next(iter(lesson.arrays)).partition(".")[0]
        self._buffers[kind].add(Samples(**{name: lesson.arrays[f"{kind}.{name}"] for name in Samples._fields}))

    def statistics(self) -> dict[str, float]:
        """Return how many samples of lessons there were."""
        return {kind: float(buffer.added) for kind, buffer in self._buffers.items()}

    def state(self) -> State:
        """Return random states, all lessons, and where those are who make them."""
        own = State({"rng": self._rng.bit_generator.state}, {"generator": self._generator.get_state()})
        kept = {kind: buffer.state() for kind, buffer in self._buffers.items()}
        return State.of({"own": own, "pool": self._pool.state()} | kept)

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        self._pool.restore(state.part("pool"))
        for kind, buffer in self._buffers.items():
            buffer.restore(state.part(kind))

    def go_on(self, state: State) -> None:
        """Have lessons made of other levels than so far."""
        self._pool.go_on(state.part("pool"))

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of the processes that make lessons, as far as they have delivered."""
        return self._pool.cpu_seconds

    def close(self) -> None:
        """End those who make lessons."""
        self._pool.close()
