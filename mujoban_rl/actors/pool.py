"""What all pools of actors do alike: hand out weights and orders, collect experience, replace actors that died."""

from __future__ import annotations

import dataclasses
import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, Literal

import numpy as np
import torch
from torch import Tensor

from mujoban_rl.actors.actor import ActorError, ActorFactory, ActorState, Arrays, Experience, Order
from mujoban_rl.engine import State

Schedule = Literal["turns", "ordered", "first"]
"""When actors play.

- `turns`: all actors play with the newest weights; once all of that has been collected, they play again. The learner
  waits meanwhile. For methods that must not learn from old weights.
- `ordered`: an actor plays on, with the newest weights, as soon as its experience was collected, and so while the
  learner learns. Experience is collected in a fixed order, so the same run gives the same numbers in every pool.
- `first`: as `ordered`, but whoever is ready is collected first, so that a slow machine holds up nobody. Runs are not
  repeatable then, and actors of a resumed run play other episodes.
"""
_PATIENCE: Final = 5
"""Times that an actor may die in a row."""
_LOG = logging.getLogger(__name__)


class ActorDied(Exception):  # noqa: N818 - what happened, not an error of the program
    """The process of an actor ended before it delivered."""


class ActorPool(ABC):
    """N actors. Each has at most one sequence that it plays or that waits for the learner.

    A pool starts with the first `collect`, so that `restore` may come before. With actors that have a `state`, what is
    collected after `restore` is what would have been collected without an interruption, unless the schedule is `first`.
    """

    in_this_process: ClassVar[bool] = True
    """Whether the actors' CPU time is this process's."""

    def __init__(self, factory: ActorFactory, count: int, schedule: Schedule) -> None:
        """Plan a pool of `count` actors.

        Raises:
            ValueError: If there is no actor.
        """
        if count < 1:
            raise ValueError(f"{count} actors: expected at least 1")
        self.factory, self.count, self.schedule = factory, count, schedule
        self.restarts = 0
        """Actors that died and were replaced."""
        self.cpu_seconds = 0.0
        """Of the actors' own processes."""
        self._version: int | None = None
        self._weights: Arrays = {}
        self._has: list[int | None] = [None] * count  # version of the weights that each actor has
        self._held: list[Arrays] = [{}] * count  # these weights
        self._streams = [0] * count
        self._left: dict[int, ActorState] = {}  # where each actor was after what was collected of it last
        self._starts: dict[int, ActorState] = {}  # where actors have yet to go on from
        self._resumed: State | None = None  # until the pool starts
        self._deaths = [0] * count  # in a row
        self._busy: list[int] = []  # in the order of their orders
        self._next_stream = 0
        self._started = False

    @abstractmethod
    def _start(self, actor: int, stream: int) -> None:
        """Make actor number `actor`, in the place of one that died where there was one."""

    @abstractmethod
    def _send(self, actor: int, order: Order) -> None:
        """Give an order to an actor that is idle; if it has died, `_receive` tells."""

    @abstractmethod
    def _receive(self, actor: int) -> Experience:
        """Wait for what a busy actor delivers.

        Raises:
            ActorDied: If it never will.
            ActorError: If it raised an error.
        """

    @abstractmethod
    def _ready(self, actors: Sequence[int]) -> int:
        """Wait until one of these busy actors has delivered or died; return the earliest of those in the sequence."""

    def close(self) -> None:  # noqa: B027 - pools without processes of their own have little to end
        """End all actors; what they play is lost."""

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Let all orders from now on carry these weights, which are copied."""
        self._weights = {name: np.array(tensor.detach().cpu().numpy()) for name, tensor in weights.items()}
        self._version = version

    def collect(self) -> Experience:
        """Wait for experience and return it; an actor that died is replaced, and only its unfinished sequence lost.

        Raises:
            ActorError: If an actor raised an error, or died several times in a row.
        """
        if self._version is None:
            raise RuntimeError("no weights: publish some before collecting experience")
        if not self._started:
            self._started = True
            self._start_all()
        while True:
            if not self._busy:
                for actor in range(self.count):
                    self._order_newest(actor)
            actor = self._ready(self._busy) if self.schedule == "first" else self._busy[0]
            self._busy.remove(actor)
            try:
                experience = self._receive(actor)
            except ActorDied as death:
                self._replace(actor, death)
                self._order_newest(actor)
                continue
            self._deaths[actor] = 0
            if experience.left is not None:
                self._left[actor] = experience.left
            if self.schedule != "turns":
                self._order_newest(actor)
            if not self.in_this_process:
                self.cpu_seconds += experience.cpu_seconds
            return dataclasses.replace(experience, actor=actor, left=None)

    def state(self) -> State:
        """Return which random streams have been used; and, but for `first`, where all actors are and their orders."""
        if self._resumed is not None:
            return self._resumed
        streams = {"next_stream": self._next_stream}
        if not self._started or self.schedule == "first":
            return State(streams)
        weights = {self._has[actor]: self._held[actor] for actor in self._busy}
        own = State(
            {**streams, "streams": list(self._streams), "has": list(self._has), "busy": list(self._busy)},
            {f"{v}/{name}": torch.tensor(array) for v, arrays in weights.items() for name, array in arrays.items()},
        )
        return State.of({"pool": own} | {f"actor{i}": left.to_state() for i, left in self._left.items()})

    def restore(self, state: State) -> None:
        """Go on to the bit where the state is that of as many actors in order; with other episodes otherwise.

        The pool must not have started.
        """
        whole = "pool" in state.values
        own = state.values["pool"] if whole else state.values
        self._next_stream = own["next_stream"]
        if whole and self.schedule != "first" and len(own["has"]) == self.count:
            self._resumed = state

    def go_on(self, state: State) -> None:
        """Play other episodes than those of the run so far, given what a light copy holds of its state."""
        self._next_stream = state.values.get("pool", state.values)["next_stream"]

    def _start_all(self) -> None:
        resumed, self._resumed = self._resumed, None
        if resumed is None:
            for actor in range(self.count):
                self._seat(actor, self._draw_stream())
            return
        own = resumed.part("pool")
        # Older checkpoints do not have the streams, but the states of all actors, in which they are.
        streams = own.values.get("streams", range(self.count))
        for actor in range(self.count):
            stream, name = streams[actor], f"actor{actor}"
            if name in resumed.values:
                left = ActorState.of(resumed.part(name))
                if left.values or left.arrays:
                    self._left[actor] = self._starts[actor] = left
                else:  # it does not say where it is, and must not play what has been seen
                    stream = self._draw_stream()
            self._seat(actor, stream)
        for actor in own.values["busy"]:
            version = own.values["has"][actor]
            prefix = f"{version}/"
            weights = {k.removeprefix(prefix): v.numpy() for k, v in own.tensors.items() if k.startswith(prefix)}
            self._order(actor, version, weights)

    def _draw_stream(self) -> int:
        self._next_stream += 1
        return self._next_stream - 1

    def _seat(self, actor: int, stream: int) -> None:
        self._streams[actor] = stream
        self._start(actor, stream)

    def _order_newest(self, actor: int) -> None:
        assert self._version is not None
        self._order(actor, self._version, self._weights)

    def _order(self, actor: int, version: int, weights: Arrays) -> None:
        known = self._has[actor] == version
        self._has[actor], self._held[actor] = version, weights
        self._busy.append(actor)
        start = self._starts.pop(actor, None)
        self._send(actor, Order(version, None if known else weights, start, report=self.schedule != "first"))

    def _replace(self, actor: int, death: ActorDied) -> None:
        self.restarts += 1
        self._deaths[actor] += 1
        if self._deaths[actor] > _PATIENCE:
            raise ActorError(f"actor {actor} died {self._deaths[actor]} times in a row: {death}")
        _LOG.warning("actor %d died (%s) and is replaced", actor, death)
        self._has[actor] = None
        self._left.pop(actor, None)
        self._seat(actor, self._draw_stream())
