"""Connection to a Ray cluster, and actors on it."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

import torch

from mujoban_rl.actors.actor import ActorError, ActorFactory, Arrays, Experience, Order, Seat
from mujoban_rl.actors.pool import ActorDied, ActorPool, Schedule
from mujoban_rl.memory import keep_freed_memory

_ANSWER_SECONDS: Final = 5.0
"""Time that a cluster has to answer; Ray itself asks on for minutes."""
_STORE_BYTES: Final = 512 * 2**20
"""Size of the object store of a cluster that runs on this machine alone: what lies in it is a few sequences."""


@dataclass(frozen=True)
class Resources:
    """What Ray sets aside for each actor; a cluster has as many actors running as it has room for."""

    cpus: float = 1.0
    memory_gb: float = 0.0
    """Gigabytes; 0 sets nothing aside."""
    custom: Mapping[str, float] = field(default_factory=dict)
    """Resources that the cluster's configuration gives a name to."""

    def options(self) -> dict[str, Any]:
        """Return the options of Ray that ask for this."""
        memory = {"memory": int(self.memory_gb * 1e9)} if self.memory_gb else {}
        return {"num_cpus": self.cpus, "resources": dict(self.custom)} | memory


class Cluster:
    """This process's connection to a Ray cluster; one on this machine is started where no address is given."""

    def __init__(self, address: str | None = None, *, cpus: float = 2.0) -> None:
        """Connect; where the process is connected already, share that.

        Args:
            address: `auto` for the cluster that runs on this machine, HOST:PORT of its head or ray://HOST:PORT.
            cpus: CPUs that a cluster on this machine has to give away.

        Raises:
            ValueError: If Ray is not installed.
            ConnectionError: If there is no cluster at the address.
        """
        # Ray reads this when it is imported: it reports how it is used to its makers otherwise.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError:
            raise ValueError("Ray is not installed: expected pip install 'mujoban[cluster]'") from None
        self.ray = ray
        self._ours = not ray.is_initialized()
        if not self._ours:
            return
        _check(address)
        own = {
            "num_cpus": max(1, round(cpus)),
            "object_store_memory": _STORE_BYTES,
            "include_dashboard": False,
            # Ray's workers yield to everything else that a machine does, and starve where it does much.
            "_system_config": {"worker_niceness": 0},
        }
        with _same_signals():
            ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, **({} if address else own))

    def close(self) -> None:
        """Leave the cluster, and end it if this has started it."""
        if self._ours:
            with _same_signals():
                self.ray.shutdown()


def _check(address: str | None) -> None:
    """Raise `ConnectionError` if there is nobody at an address of the form HOST:PORT."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), _ANSWER_SECONDS).close()
    except OSError as error:
        raise ConnectionError(f"no Ray cluster at {address}: {error}") from None


@contextmanager
def _same_signals() -> Iterator[None]:
    """Leave the handlers of signals as they are: Ray puts its own in the place of those that save a checkpoint."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class RayPool(ActorPool):
    """Actors on a Ray cluster, wherever there is room for them."""

    in_this_process = False

    def __init__(
        self,
        factory: ActorFactory,
        count: int,
        schedule: Schedule = "first",
        *,
        address: str | None = None,
        resources: Resources | None = None,
        threads: int = 1,
    ) -> None:
        """Plan a pool; the connection is made when it starts.

        Args:
            factory: Makes the actors; its module must be installed on all machines of the cluster.
            count: Number of actors.
            schedule: When they play.
            address: See `Cluster`.
            resources: What each actor needs.
            threads: Threads of torch in each.
        """
        super().__init__(factory, count, schedule)
        self._address, self._resources, self._threads = address, resources or Resources(), threads
        self._cluster: Cluster | None = None
        self._make: Any = None
        self._actors: dict[int, Any] = {}
        self._answers: dict[int, Any] = {}
        self._shared: tuple[int, Any] | None = None  # version and reference of the weights in the object store

    def close(self) -> None:
        """End the actors and leave the cluster."""
        if self._cluster is None:
            return
        for actor in self._actors.values():
            self._cluster.ray.kill(actor)
        self._actors, self._answers, self._shared = {}, {}, None
        self._cluster.close()
        self._cluster = None

    @property
    def _ray(self) -> Any:
        assert self._cluster is not None
        return self._cluster.ray

    def _start_all(self) -> None:
        self._cluster = Cluster(self._address, cpus=self.count * self._resources.cpus)
        # Ray would make an actor anew with the random stream that it had, whose episodes have been seen.
        self._make = self._ray.remote(max_restarts=0, **self._resources.options())(_RemoteSeat)
        super()._start_all()

    def _start(self, actor: int, stream: int) -> None:
        if actor in self._actors:
            self._ray.kill(self._actors.pop(actor))
        self._actors[actor] = self._make.remote(stream, self._threads)

    def _send(self, actor: int, order: Order) -> None:
        weights = None
        if order.weights is not None:
            if self._shared is None or self._shared[0] != order.version:
                self._shared = order.version, self._ray.put(dict(order.weights))
            weights = self._shared[1]
        self._answers[actor] = self._actors[actor].play.remote(self.factory, replace(order, weights=None), weights)

    def _receive(self, actor: int) -> Experience:
        errors = self._ray.exceptions
        try:
            return self._ray.get(self._answers.pop(actor))
        except errors.RayTaskError as error:
            raise ActorError(f"actor {actor} raised an error:\n{error}") from None
        except errors.RayError as error:
            raise ActorDied(" ".join(str(error).split())) from None

    def _ready(self, actors: Sequence[int]) -> int:
        answers = [self._answers[actor] for actor in actors]
        ready, _ = self._ray.wait(answers, num_returns=1)
        return actors[answers.index(ready[0])]


class _RemoteSeat:
    """A seat in a process of Ray's."""

    def __init__(self, stream: int, threads: int) -> None:
        keep_freed_memory()
        torch.set_num_threads(threads)
        self._stream = stream
        self._seat: Seat | None = None

    def play(self, factory: ActorFactory, order: Order, weights: Arrays | None) -> Experience:
        # Made here, since Ray reports an error in a constructor as the death of the actor.
        if self._seat is None:
            self._seat = Seat(factory(self._stream))
        return self._seat.play(replace(order, weights=weights))
