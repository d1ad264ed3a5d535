"""Actors inside of the learner's process: one after the other, or each in a thread."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from mujoban_rl.actors.actor import ActorFactory, Experience, Order, Seat
from mujoban_rl.actors.pool import ActorPool, Schedule


class LocalPool(ActorPool):
    """Actors that play when their experience is collected."""

    def __init__(self, factory: ActorFactory, count: int = 1, schedule: Schedule = "turns") -> None:
        """Plan a pool; `first` is the same as `ordered` here."""
        super().__init__(factory, count, "ordered" if schedule == "first" else schedule)
        self._seats: list[Seat] = []
        self._orders: dict[int, Order] = {}

    def close(self) -> None:
        """Close the actors."""
        for seat in self._seats:
            seat.actor.close()

    def _start(self, actor: int, stream: int) -> None:
        self._seats.append(Seat(self.factory(stream)))

    def _send(self, actor: int, order: Order) -> None:
        self._orders[actor] = order

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
