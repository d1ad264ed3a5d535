"""What searches taught, as batches."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from mujoban_planner.samples import Batch, SampleBuffer, Samples, concatenate, make_batch
from mujoban_planner.search_lessons import KINDS, SearchConfig
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.uncertainty import Uncertainty
from mujoban_rl.actors import Experience
from mujoban_rl.engine import State

_JUDGED: Final = {"audit": 0.45, "played": 0.35}
"""Shares of the states of a batch that are on no way by what is known of them; of the others what was proved."""


class LessonStore:
    """The newest lessons of searches, as batches under random symmetries, blurred and with cells hidden."""

    def __init__(self, config: SearchConfig, seed: int) -> None:
        """Make room for lessons; `seed` chooses batches."""
        self.config = config
        self.buffers = {kind: SampleBuffer(config.buffer) for kind in KINDS}
        self._uncertainty = Uncertainty(config)
        self._rng = np.random.default_rng([seed, 6])
        self._generator = torch.Generator().manual_seed(seed)

    def add(self, experience: Experience) -> None:
        """Keep what an actor delivered."""
        for kind, buffer in self.buffers.items():
            buffer.add(Samples._make(experience.arrays[f"{kind}.{name}"] for name in Samples._fields))

    def sample(self) -> Batch | None:
        """Return a batch, once so many states of ways are there: a good planner wins its first levels by itself."""
        size, held = self.config.batch_size, {kind: buffer.size for kind, buffer in self.buffers.items()}
        if held["way"] < size:
            return None
        judged = int(size * self.config.judged)
        freely = {kind: int(judged * share) if held[kind] > size else 0 for kind, share in _JUDGED.items()}
        proved = judged - sum(freely.values()) if held["verdict"] > size else 0
        counts = {"way": size - sum(freely.values()) - proved, "verdict": proved, **freely}
        parts = [self.buffers[kind].draw(count, self._rng) for kind, count in counts.items() if count]
        # What is blurred and hidden are the first and the last of a batch: states of all kinds, hence.
        order = self._rng.permutation(size)
        batch = make_batch(concatenate(parts).take(order), self._rng.integers(0, SYMMETRIES, size))
        state = self._uncertainty.apply(batch.state, self._generator, self._rng)
        return batch._replace(state=state, chosen=torch.from_numpy(order < counts["way"] + counts["verdict"]))

    def state(self) -> State:
        """Return the lessons and the random states."""
        own = State({"rng": self._rng.bit_generator.state}, {"generator": self._generator.get_state()})
        return State.of({"own": own} | {kind: buffer.state() for kind, buffer in self.buffers.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        for kind, buffer in self.buffers.items():
            buffer.restore(state.part(kind))
