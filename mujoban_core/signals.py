"""Signals that ask a program to end: the one place where they are handled, for commands, nodes and trainers.

Work that must be finished in order, such as a bag that is being written, runs within a `StopSignal`, which notes a
signal and lets the work end itself. All other code of a program is cut short by an `Interrupted`.
"""

from __future__ import annotations

import atexit
import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Final, NoReturn, Self

from mujoban_core.worker import end_workers

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a polite kill, a terminal that was closed."""
_UNSAFE: Final = ("numba", "llvmlite", "ctypes")
"""Packages in which an interruption is lost or ends the process: see `_put_off`."""
_LATER: Final = 0.05
"""Seconds after which a signal that was put off comes again."""
_LOST: Final = 0.3
"""Seconds after which an interruption that has not left its context is looked after."""
AGAIN: Final = 0.5
"""Seconds after the first signal from which on another SIGINT is a second one; runners that pass on what the terminal
has sent already, such as make, deliver one twice."""


class Interrupted(KeyboardInterrupt):
    """A signal asked the process to end."""

    def __init__(self, number: int) -> None:
        """Name the signal."""
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def status(self) -> int:
        """Exit status that shells give to a program that a signal has ended: 130 for SIGINT, 143 for SIGTERM."""
        return 128 + self.number


def interrupt_status(error: KeyboardInterrupt) -> int:
    """Return the exit status of a program that was interrupted."""
    return error.status if isinstance(error, Interrupted) else 128 + signal.SIGINT


def interruption(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that an error hides, if there is one.

    Writing to the terminal fails after one where the terminal was closed, an extension module that is interrupted
    while it is imported says in its place that it cannot be initialised, and a class that a call of `__set_name__`
    failed.
    """
    earlier = error.__context__
    while earlier is not None and not isinstance(earlier, KeyboardInterrupt):
        earlier = earlier.__context__
    return earlier


def leave(status: int) -> NoReturn:
    """End the process once what was registered with `atexit` has run; nobody waits for what workers have not begun.

    The interpreter is not taken down in order: with PyTorch and ROS in it that takes seconds on a busy machine.
    """
    end_workers(drop=True)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a terminal that was closed, a pipe whose reader has left
            stream.flush()
    os._exit(status)


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Interrupted` in the main thread where a signal asks the process to end.

    What a handler raises while an object is deleted, or where a library calls back, is lost; then it is raised again.
    """
    insisting = _Insisting()
    before = _handle(insisting.interrupt)
    try:
        yield
    finally:
        insisting.end()
        _put_back(before)


class _Insisting:
    """Raises `Interrupted`, and has the signal sent again until that is on its way out of the context."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ended = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        if _is_raised() or _put_off(number, frame):
            return
        timer = threading.Timer(_LOST, self._send, (number,))
        timer.daemon = True
        timer.start()
        raise Interrupted(number)

    def _send(self, number: int) -> None:
        with self._lock:
            if not self._ended:
                os.kill(os.getpid(), number)

    def end(self) -> None:
        """Send nothing any more."""
        with self._lock:
            self._ended = True


def _is_raised() -> bool:
    """Tell whether an interruption is being put away just now: in a `finally`, an `except`, at the end of a `with`."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, Interrupted):
        error = error.__context__
    return error is not None


_Handler = Callable[[int, FrameType | None], object] | int | None


class StopSignal:
    """Context in which a signal asks the work to end instead of cutting it short.

    A second SIGINT cuts it short all the same, by `Interrupted`. Once that has been raised, further signals change
    nothing, so that what was begun is put away in order. In threads but the main one nothing is handled.

    Attributes:
        number: The first signal that came, or None.
        deferred: Whether signals wait for the work; while it is false, the first one raises `Interrupted` at once.
    """

    def __init__(self, *, deferred: bool = True, heard: Callable[[], None] | None = None) -> None:
        """Call `heard` in a thread of its own when the first signal comes for which the work is not cut short."""
        self.deferred = deferred
        self._heard = heard
        self.number: int | None = None
        self._at = 0.0
        self._raised = False
        self._before: dict[signal.Signals, _Handler] = {}

    @property
    def requested(self) -> bool:
        """Whether a signal came."""
        return self.number is not None

    def check(self) -> None:
        """Raise `Interrupted` if a signal came."""
        if self.number is not None:
            self._raised = True
            raise Interrupted(self.number)

    @contextmanager
    def immediate(self) -> Iterator[None]:
        """Have a signal raise `Interrupted` at once inside, also one that came before: work that may be given up."""
        self.deferred = False
        try:
            self.check()
            yield
        finally:
            self.deferred = True

    @contextmanager
    def waking(self, wake: Callable[[], None]) -> Iterator[None]:
        """Call `wake` as soon as a signal comes, from another thread: for work that waits outside of Python.

        Python runs a signal's handler between two of its own instructions, of which there may be none for long. The
        C library's handler writes into a pipe at once.
        """
        if not self._before:  # not in the main thread: no signal arrives here
            yield
            return
        ours, theirs = os.pipe()
        os.set_blocking(theirs, False)
        watcher = threading.Thread(target=self._watch, args=(ours, wake), name="signals", daemon=True)
        watcher.start()
        before = signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
        try:
            if self.requested:
                wake()
            yield
        finally:
            signal.set_wakeup_fd(before)
            os.close(theirs)
            watcher.join()
            os.close(ours)

    def _watch(self, pipe: int, wake: Callable[[], None]) -> None:
        while numbers := os.read(pipe, 64):
            for number in set(numbers).intersection(self._before):
                self._note(number)
                wake()

    def _note(self, number: int) -> None:
        if self.number is None:
            self.number, self._at = number, time.monotonic()

    def _handler(self, number: int, frame: FrameType | None) -> None:
        again = self.requested and number == signal.SIGINT and time.monotonic() - self._at > AGAIN
        if self.deferred and not self.requested and self._heard is not None:
            # In a thread, since what the signal came amid may be writing as well.
            threading.Thread(target=self._heard, name="heard", daemon=True).start()
        self._note(number)
        if (again or not self.deferred) and not self._raised and not _put_off(number, frame):
            self._raised = True
            raise Interrupted(number)

    def __enter__(self) -> Self:
        """Handle signals."""
        self._before = _handle(self._handler)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the former handlers back; writing to a terminal that was closed failed for the signal's sake."""
        _put_back(self._before)
        self._before = {}
        if self.number is not None and isinstance(value, OSError) and value.errno == errno.EIO:
            raise Interrupted(self.number) from value


def _put_off(number: int, frame: FrameType | None) -> bool:
    """Tell whether a signal came where nothing must be raised; it will then come again.

    What is raised while functions are compiled is lost in a callback of LLVM, with words on the terminal, or comes out
    as another error. A first start compiles for some seconds, later ones not at all. And a compiled function that takes
    a random generator asks `ctypes.cast` for addresses and does not look whether that failed: a segmentation fault.
    """
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in _UNSAFE:
            later = threading.Timer(_LATER, os.kill, (os.getpid(), number))
            later.daemon = True
            later.start()
            return True
        frame = frame.f_back
    return False


def _handle(handler: Callable[[int, FrameType | None], None]) -> dict[signal.Signals, _Handler]:
    """Install a handler and return those before it; a SIGHUP that is ignored, as under nohup, stays so."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handled = [s for s in STOP_SIGNALS if s != signal.SIGHUP or signal.getsignal(s) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in handled}


def _put_back(handlers: dict[signal.Signals, _Handler]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
