"""Progress on stderr, on which no work depends."""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from typing import IO, TextIO, cast

from rich.console import Console


def progress_console() -> Console:
    """Return a console on stderr that nobody needs to read.

    When the terminal has been closed, or the other end of a pipe has gone (an interrupt from the keyboard ends `tee` as
    well), what is written is lost and the work goes on: rich's own consoles would leave the process without saving it.
    """
    return Console(file=cast("IO[str]", _Lasting()))


class _Lasting(io.TextIOBase):
    """Stderr as it is when it is written to; what it no longer takes is dropped."""

    @property
    def _stream(self) -> TextIO:
        # While rich shows a bar it puts a stream of its own in the place of stderr, which prints above the bar.
        return getattr(sys.stderr, "rich_proxied_file", sys.stderr)

    def write(self, text: str) -> int:
        """Write text if that is possible."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        with suppress(OSError):
            self._stream.flush()

    def isatty(self) -> bool:
        """Return whether stderr is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the descriptor of stderr."""
        return self._stream.fileno()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Name of its encoding."""
        return self._stream.encoding
