"""Actors inside of the learner's process: one after the other, resumable to the bit, or each in a thread."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

import torch

from mujoban_rl.actors.actor import ActorFactory, Arrays, Experience, Order, Seat
from mujoban_rl.actors.pool import ActorPool, Schedule
from mujoban_rl.engine import State


class LocalPool(ActorPool):
    """Actors that play when their experience is collected; a run with them resumes to the bit."""

    def __init__(self, factory: ActorFactory, count: int = 1, schedule: Schedule = "turns") -> None:
        """Plan a pool; `first` is the same as `ordered` here."""
        super().__init__(factory, count, schedule)
        self._seats: list[Seat] = []
        self._orders: dict[int, Order] = {}
        self._held: list[Arrays] = [{}] * count  # the weights of each actor's last order
        self._resumed: State | None = None

    def state(self) -> State:
        """Return the actors' states and the orders that wait, with their weights."""
        if self._resumed is not None:
            return self._resumed
        own = super().state()
        if not self._started:
            return own
        weights = {self._has[actor]: self._held[actor] for actor in self._busy}
        own = State(
            {**own.values, "has": list(self._has), "busy": list(self._busy)},
            {f"{v}/{name}": torch.tensor(array) for v, arrays in weights.items() for name, array in arrays.items()},
        )
        return State.of({"pool": own} | {f"actor{i}": seat.actor.state() for i, seat in enumerate(self._seats)})

    def restore(self, state: State) -> None:
        """Go on to the bit where the state is that of as many local actors; with other episodes otherwise."""
        local = "pool" in state.values
        own = state.part("pool") if local else state
        super().restore(own)
        if local and len(own.values["has"]) == self.count:
            self._resumed = state

    def close(self) -> None:
        """Close the actors."""
        for seat in self._seats:
            seat.actor.close()

    def _start_all(self) -> None:
        if self._resumed is None:
            super()._start_all()
            return
        own = self._resumed.part("pool")
        self._busy = list(own.values["busy"])
        for actor in range(self.count):
            # Which stream it is matters no more: all that was drawn from it is in the actor's state.
            self._start(actor, actor)
            self._seats[actor].actor.restore(self._resumed.part(f"actor{actor}"))
        for actor in self._busy:
            version = own.values["has"][actor]
            prefix = f"{version}/"
            weights = {k.removeprefix(prefix): v.numpy() for k, v in own.tensors.items() if k.startswith(prefix)}
            self._has[actor] = version
            self._send(actor, Order(version, weights))
        self._resumed = None

    def _start(self, actor: int, stream: int) -> None:
        self._seats.append(Seat(self.factory(stream)))

    def _send(self, actor: int, order: Order) -> None:
        self._orders[actor] = order
        if order.weights is not None:
            self._held[actor] = order.weights

    def _receive(self, actor: int) -> Experience:
        return self._seats[actor].play(self._orders.pop(actor))

    def _ready(self, actors: Sequence[int]) -> int:
        return actors[0]


class ThreadPool(ActorPool):
    """Actors in threads of the learner's process: worth it where they leave Python for most of their time."""

    def __init__(self, factory: ActorFactory, count: int, schedule: Schedule = "ordered") -> None:
        """Plan a pool of `count` threads."""
        super().__init__(factory, count, schedule)
        # A thread for each actor, in which it is made too: OpenGL contexts and modes of torch belong to a thread.
        self._threads = [ThreadPoolExecutor(1, f"actor-{i}") for i in range(count)]
        self._seats: dict[int, Seat] = {}
        self._futures: dict[int, Future[Experience]] = {}

    def close(self) -> None:
        """Wait for what the actors play, and close them."""
        for actor, thread in enumerate(self._threads):
            if actor in self._seats:
                thread.submit(self._seats[actor].actor.close)
            thread.shutdown()

    def _start(self, actor: int, stream: int) -> None:
        def make() -> None:
            self._seats[actor] = Seat(self.factory(stream))

        self._threads[actor].submit(make).result()

    def _send(self, actor: int, order: Order) -> None:
        self._futures[actor] = self._threads[actor].submit(self._seats[actor].play, order)

    def _receive(self, actor: int) -> Experience:
        return self._futures.pop(actor).result()

    def _ready(self, actors: Sequence[int]) -> int:
        futures = [self._futures[actor] for actor in actors]
        done = wait(futures, return_when=FIRST_COMPLETED).done
        return next(actor for actor, future in zip(actors, futures, strict=True) if future in done)
