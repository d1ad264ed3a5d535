"""A thread of its own for what belongs to one thread, such as an OpenGL context."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")


class Worker:
    """Runs functions in one thread, in their order.

    Unlike those of `concurrent.futures.ThreadPoolExecutor`, `submit` and `end` take no lock: the garbage collector may
    call them, through a finalizer, in a thread that holds any lock, even while that thread starts a pool of its own.
    """

    def __init__(self, name: str) -> None:
        """Start the thread, which does not keep the interpreter from ending."""
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=_work, args=(self._jobs,), name=name, daemon=True)
        self._thread.start()
        _WORKERS.add(self)

    def submit(self, function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Run a function in the thread, after those before it."""
        future: Future[_T] = Future()

        def job() -> None:
            try:
                future.set_result(function(*args, **kwargs))
            except BaseException as error:
                future.set_exception(error)

        self._jobs.put(job)
        return future

    def drop(self) -> None:
        """Forget what has not begun; nobody is told."""
        with suppress(Empty):
            while True:
                self._jobs.get_nowait()

    def end(self) -> None:
        """Let the thread end after what was submitted, without waiting for it."""
        self._jobs.put(None)

    def join(self) -> None:
        """Wait until the thread has ended."""
        self._thread.join()


def _work(jobs: SimpleQueue[Callable[[], None] | None]) -> None:
    while (job := jobs.get()) is not None:
        job()


_WORKERS: weakref.WeakSet[Worker] = weakref.WeakSet()


def end_workers(*, drop: bool = False) -> None:
    """Let what was submitted finish before the interpreter goes: a library must not be cut off in the middle.

    Args:
        drop: Whether only what has begun is finished.
    """
    for worker in list(_WORKERS):
        if drop:
            worker.drop()
        worker.end()
        worker.join()


# Before what is registered with `atexit`, such as the end of EGL's display, which a painter may be opening just then;
# as the pools of `concurrent.futures` do.
threading._register_atexit(end_workers)  # pyright: ignore[reportAttributeAccessIssue]
