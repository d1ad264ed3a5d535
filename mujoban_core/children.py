"""Processes that end when the one that started them ends, however that happens (Linux)."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Final

_PARENT: Final = "MUJOBAN_PARENT"
"""Environment variable that names the process which started this one."""
_LAST_WORD: Final = "MUJOBAN_LAST_WORD"
"""Environment variable that names the file which takes what error has ended the process."""
_C_LIBRARY: Final = "GLIBC_TUNABLES"
"""Environment variable with settings of glibc, which it reads when a program starts."""
_PR_SET_PDEATHSIG: Final = 1
GRACE: Final = 0.5
"""Seconds that a process has to end when it is asked to; who asks has to end within two, on a busy machine as well."""


def start(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    log: IO[bytes] | None = None,
    last_word: Path | None = None,
) -> subprocess.Popen[bytes]:
    """Start a program that calls `end_with_parent`.

    What the terminal sends, such as Ctrl-C, goes to this process alone, which ends its children in order.

    Args:
        command: The program and its arguments.
        environment: Variables on top of this process's environment.
        log: File that takes what the program prints; None means where this process prints.
        last_word: File that takes the error by which the program ends, if it uses `telling`.
    """
    variables = {**os.environ, **(environment or {}), _PARENT: str(os.getpid())}
    if last_word is not None:
        variables[_LAST_WORD] = str(last_word)
    return subprocess.Popen(command, env=variables, process_group=0, stdout=log, stderr=log)


@contextmanager
def sheltered() -> Iterator[None]:
    """Keep the terminal's Ctrl-C from the processes of `multiprocessing` that are started within.

    They inherit that the signal is blocked; this process receives it when the context ends.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def large_pages() -> Iterator[None]:
    """Have programs that are started within keep what they allocate in pages of 2 MiB, where the kernel allows it.

    It has fewer pages to take back then when a process with much memory ends.
    Settings of the C library that the environment has already stay as they are.
    """
    if _C_LIBRARY in os.environ:
        yield
        return
    os.environ[_C_LIBRARY] = "glibc.malloc.hugetlb=1"
    try:
        yield
    finally:
        del os.environ[_C_LIBRARY]


def end_with_parent() -> None:
    """Have this process asked to end, by SIGTERM, when its parent ends, even when that is killed.

    The parent is the process that has used `start` or `multiprocessing`; without one nothing happens.

    Raises:
        SystemExit: If the parent has ended already.
    """
    parent = multiprocessing.parent_process()
    pid = os.environ.pop(_PARENT, None) if parent is None else parent.pid
    if pid is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != int(pid):
        raise SystemExit(128 + signal.SIGTERM)


@contextmanager
def telling() -> Iterator[None]:
    """Note an error that comes out of this context for the process that has started this one, if it wants to know."""
    file = os.environ.pop(_LAST_WORD, None)
    try:
        yield
    except Exception as error:
        if file is not None:
            with suppress(OSError):
                Path(file).write_text(f"{type(error).__name__}: {error}")
        raise


def outlast(seconds: int) -> None:
    """Have the first SIGTERM end this process after some seconds, unless its parent has ended; a second one, at once.

    One that goes to a whole group of processes reaches this one together with its parent, which still takes what this
    one makes until it has come to an end in order.
    """
    parent, asked = os.getppid(), False

    def end(_: int, __: FrameType | None) -> None:
        nonlocal asked
        if asked or os.getppid() != parent:
            os._exit(128 + signal.SIGTERM)
        asked = True
        signal.alarm(seconds)

    signal.signal(signal.SIGTERM, end)


def stop(children: Iterable[subprocess.Popen[bytes]], grace: float = GRACE) -> int:
    """Ask programs to end, and kill those that have not after `grace` seconds; return how many those were."""
    running = list(children)
    for child in running:
        child.terminate()
    deadline = time.monotonic() + grace
    late = [child for child in running if not _ends(child, deadline)]
    for child in late:  # all before any is waited for: on a busy machine each takes its time to die
        child.kill()
    for child in late:
        child.wait()
    return len(late)


def _ends(child: subprocess.Popen[bytes], deadline: float) -> bool:
    """Wait for a process until a moment of `time.monotonic`; tell whether it has ended."""
    try:
        child.wait(max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return False
    return True
