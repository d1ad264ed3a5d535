"""Actors in worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Final

import torch

from mujoban_core import children
from mujoban_rl.actors.actor import ActorError, ActorFactory, Experience, Order, Seat
from mujoban_rl.actors.pool import ActorDied, ActorPool, Schedule
from mujoban_rl.memory import keep_freed_memory

_CONTEXT: Final = multiprocessing.get_context("spawn")
_GRACE: Final = 1.0
"""Seconds that a process has to end of which the other end of the pipe is gone."""
_LAST: Final = 60
"""Seconds that an actor plays on after a SIGTERM to all, in which the learner takes what it needs and is saved."""


class _Seated:
    """An actor has been made and waits for its first order."""


@dataclass(frozen=True)
class _Failure:
    """An actor raised an error."""

    text: str


@dataclass(frozen=True)
class _Death:
    """The process of an actor has ended."""

    status: int | None


class ProcessPool(ActorPool):
    """Actors in processes, at the other end of a pipe each; they end with their pipe, so with a learner that dies."""

    in_this_process = False

    def __init__(
        self, factory: ActorFactory, count: int, schedule: Schedule = "ordered", *, threads: int = 1
    ) -> None:
        """Plan a pool of `count` processes with `threads` threads of torch each."""
        super().__init__(factory, count, schedule)
        self._threads = threads
        self._workers: dict[int, tuple[BaseProcess, Connection]] = {}
        self._seated: set[int] = set()
        self._first_orders: dict[int, Order] = {}
        self._answers: dict[int, Experience | _Failure | _Death] = {}

    def close(self) -> None:
        """End the processes."""
        for process, pipe in self._workers.values():
            pipe.close()
            process.kill()  # it has nothing to put in order
        for process, _ in self._workers.values():
            process.join()
        self._workers = {}

    def _start(self, actor: int, stream: int) -> None:
        if actor in self._workers:
            process, pipe = self._workers.pop(actor)
            pipe.close()
            process.kill()
            process.join()
            self._seated.discard(actor)
        ours, theirs = _CONTEXT.Pipe()
        process = _CONTEXT.Process(
            target=_serve, args=(theirs, self.factory, stream, self._threads),
            name=f"actor-{actor}", daemon=True,
        )  # fmt: skip
        with children.sheltered():
            process.start()
        theirs.close()
        self._workers[actor] = process, ours

    def _send(self, actor: int, order: Order) -> None:
        if actor in self._seated:
            self._write(actor, order)
        else:
            # The process takes seconds to import what it needs, in which it would not read from its pipe.
            self._first_orders[actor] = order

    def _receive(self, actor: int) -> Experience:
        self._ready([actor])
        answer = self._answers.pop(actor)
        if isinstance(answer, _Failure):
            raise ActorError(f"actor {actor} raised an error:\n{answer.text}")
        if isinstance(answer, _Death):
            raise ActorDied(f"exit status {answer.status}")
        return answer

    def _ready(self, actors: Sequence[int]) -> int:
        while not (answered := [actor for actor in actors if actor in self._answers]):
            # All pipes are read while one is waited for, so that nobody waits to deliver or for a first order.
            waiting = {pipe: actor for actor, (_, pipe) in self._workers.items() if actor not in self._answers}
            for pipe in wait(list(waiting)):
                self._read(waiting[pipe], pipe)  # pyright: ignore[reportArgumentType]
        return answered[0]

    def _read(self, actor: int, pipe: Connection) -> None:
        try:
            answer = pipe.recv()
        except (EOFError, OSError):
            process, _ = self._workers[actor]
            process.join(_GRACE)
            answer = _Death(process.exitcode)
        if isinstance(answer, _Seated):
            self._seated.add(actor)
            if actor in self._first_orders:
                self._write(actor, self._first_orders.pop(actor))
        else:
            self._answers[actor] = answer

    def _write(self, actor: int, order: Order) -> None:
        # The pipe of a process that has died takes nothing; reading from it tells.
        with suppress(OSError):
            self._workers[actor][1].send(order)


def _serve(pipe: Connection, factory: ActorFactory, stream: int, threads: int) -> None:
    """Carry out orders until the pipe is closed."""
    children.end_with_parent()
    children.outlast(_LAST)
    keep_freed_memory()
    torch.set_num_threads(threads)
    try:
        seat = Seat(factory(stream))
        pipe.send(_Seated())
        while (order := _next(pipe)) is not None:
            experience = seat.play(order)
            with suppress(OSError):
                pipe.send(experience)
    except Exception:
        with suppress(OSError):
            pipe.send(_Failure(traceback.format_exc()))


def _next(pipe: Connection) -> Order | None:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None
