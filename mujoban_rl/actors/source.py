"""Batches from a replay that actors fill while a learner learns from it (paper C.5)."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Final, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from mujoban_rl.actors.actor import Arrays, Experience
from mujoban_rl.actors.pool import ActorPool
from mujoban_rl.engine import Scalars, Source, State
from mujoban_rl.metrics import COUNT
from mujoban_rl.replay import SequenceReplay

BatchT = TypeVar("BatchT")
_BatchT_co = TypeVar("_BatchT_co", covariant=True)
_LEARNER: Final = 0x6C6561
"""Sets a learner's random streams apart from those of actors."""


def learner_generators(seed: int, count: int) -> list[torch.Generator]:
    """Return generators of a learner and its store, by the seed of a run, whose actors draw by `[seed, number]`."""
    # Not of [seed] alone, which is what NumPy makes of [seed, 0], the first actor's.
    streams = np.random.SeedSequence([_LEARNER, seed]).spawn(count)
    return [torch.Generator().manual_seed(int(stream.generate_state(1)[0])) for stream in streams]


class ExperienceStore(Protocol[_BatchT_co]):
    """A replay, as a source sees it."""

    def add(self, experience: Experience) -> None:
        """Take in what an actor delivered; its arrays may be read-only, and are not kept alive by anybody else."""

    def sample(self) -> _BatchT_co | None:
        """Return a batch to learn from, or None as long as there is too little for one."""
        ...

    def state(self) -> State:
        """Return all that changes: contents, or nothing where a resumed run fills it anew, and randomness."""
        ...

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""


class ActorSource(Source[BatchT], Generic[BatchT]):
    """Collects so many steps of actors for every update of the learner, however fast either of them is.

    The paper keeps this ratio the same by the number of actors that it gives to each module; here whoever is ahead
    waits for the other.
    """

    def __init__(
        self, pool: ActorPool, store: ExperienceStore[BatchT], *, steps_per_update: float = 0.0, first_steps: int = 0
    ) -> None:
        """Draw batches from a store that a pool fills.

        Args:
            pool: The actors.
            store: The replay.
            steps_per_update: Environment steps that are collected for each update; 0: as many as the store needs for a
                batch.
            first_steps: Environment steps that are collected before the first update, in addition.

        Raises:
            ValueError: If a number is out of its range.
        """
        if not steps_per_update >= 0.0 or first_steps < 0:
            raise ValueError(
                f"{steps_per_update} steps per update, {first_steps} before: expected at least 0 of both"
            )
        self.pool, self.store = pool, store
        self._ratio, self._first = steps_per_update, first_steps
        self._updates = 0
        self._before: int | None = None  # updates of the run before a light copy of it, which versions count too
        self._seen: dict[str, list[float]] = {}
        self._staleness: list[int] = []
        self._since = time.monotonic(), 0  # when statistics were asked for last, steps since then

    def next_batch(self) -> BatchT:
        """Return a batch, once the steps that are due for it have come in, and what they taught is enough for one.

        Raises:
            ActorError: If an actor raised an error, or dies again and again.
        """
        due = self.began + self._first + self._ratio * (self._updates + 1)
        while self.samples < due or (batch := self.store.sample()) is None:
            self._add(self.pool.collect())
        self._updates += 1
        return batch

    def _add(self, experience: Experience) -> None:
        self.store.add(experience)
        self.samples += experience.steps
        self._since = self._since[0], self._since[1] + experience.steps
        self._staleness.append((self._before or 0) + self._updates - experience.version)
        for name, values in experience.statistics.items():
            self._seen.setdefault(name, []).extend(np.ravel(values).tolist())

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Let actors play with these weights from their next sequence on."""
        if self._before is None:
            self._before = max(0, version - self._updates)
        self.pool.publish(weights, version)

    def statistics(self) -> Scalars:
        """Return means of what happened, how many each is of, frames per second, and the weights' age in updates."""
        start, steps = self._since
        self._since = time.monotonic(), 0
        values = {name: float(np.mean(seen)) for name, seen in self._seen.items() if seen}
        values |= {name + COUNT: float(len(seen)) for name, seen in self._seen.items() if seen}
        values["actors/frames_per_second"] = steps / max(time.monotonic() - start, 1e-9)
        if self._staleness:
            values["actors/staleness"] = float(np.mean(self._staleness))
            values["actors/staleness_max"] = float(max(self._staleness))
        values["actors/restarts"] = float(self.pool.restarts)
        self._seen, self._staleness = {}, []
        return values

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of the actors' processes, as far as they have delivered."""
        return self.pool.cpu_seconds

    def state(self) -> State:
        """Return the state of pool and store."""
        own = State({"updates": self._updates})
        return State.of({"own": own, "pool": self.pool.state(), "store": self.store.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._updates = state.part("own").values["updates"]
        self.pool.restore(state.part("pool"))
        self.store.restore(state.part("store"))

    def go_on(self, state: State) -> None:
        """Have the actors play other episodes than so far."""
        self.pool.go_on(state.part("pool"))

    def close(self) -> None:
        """End the actors."""
        self.pool.close()


class ReplayStore(ABC, Generic[BatchT]):
    """A replay of sequences, as actors deliver them; subclasses say how batches are drawn."""

    def __init__(self, replay: SequenceReplay, generator: torch.Generator) -> None:
        """Hold what is kept in `replay`; `generator` draws."""
        self.replay, self.generator = replay, generator

    def add(self, experience: Experience) -> None:
        """Take in the sequences of an actor, [L, B, ...] each."""
        self.replay.add(experience.arrays)

    @abstractmethod
    def sample(self) -> BatchT | None:
        """Return a batch to learn from, or None as long as there is too little for one."""

    def parts(self) -> dict[str, State]:
        """Return all that changes, by name."""
        return {"own": State(tensors={"generator": self.generator.get_state()}), "replay": self.replay.state()}

    def state(self) -> State:
        """Return contents and randomness."""
        return State.of(self.parts())

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.generator.set_state(state.part("own").tensors["generator"])
        self.replay.restore(state.part("replay"))


class Rollouts:
    """Hands on what actors delivered, once: the store of methods that learn from the newest experience alone."""

    def __init__(self, axis: int, count: int) -> None:
        """Put `count` rollouts, one of each actor, side by side along an axis, that of their environments."""
        self._axis, self._count = axis, count
        self._parts: list[Arrays] = []

    def add(self, experience: Experience) -> None:
        """Take the rollout of an actor."""
        self._parts.append(experience.arrays)

    def sample(self) -> Arrays | None:
        """Return the rollouts since the last call, None while there are fewer than actors."""
        if len(self._parts) < self._count:
            return None
        parts, self._parts = self._parts, []
        return {name: np.concatenate([part[name] for part in parts], axis=self._axis) for name in parts[0]}

    def state(self) -> State:
        """Return nothing: between two updates there is nothing."""
        return State()

    def restore(self, state: State) -> None:
        """Take over nothing."""
