"""Ctrl-C before a program can handle it: what it imports takes a second, on a busy machine many.

It stands before all other imports of a program, where `__name__` is `"__main__"`: what imports a program as a module
keeps its own handler.
"""

from __future__ import annotations

import signal


def end_at_once() -> None:
    """Let SIGINT end the process without a traceback until its command handles signals; shells then say 130."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
