"""Keep two graphs on one machine apart: each takes a ROS domain of its own."""

from __future__ import annotations

import fcntl
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

DOMAINS = range(102)
"""Domains that Linux's ephemeral ports do not reach into."""


@contextmanager
def claim_domain() -> Iterator[int]:
    """Hold a ROS domain while a graph runs, and name it in the environment.

    `ROS_DOMAIN_ID` decides where it is set. Otherwise the first domain is taken that no other graph of this
    machine holds.
    """
    chosen = os.environ.get("ROS_DOMAIN_ID")
    if chosen:
        yield int(chosen)
        return
    for domain in DOMAINS:
        lock = _lock(domain)
        if lock is None:
            continue
        if domain != 0:
            print(f"another graph runs on this machine: using ROS_DOMAIN_ID={domain}", file=sys.stderr)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        try:
            yield domain
        finally:
            del os.environ["ROS_DOMAIN_ID"]
            lock.close()
        return
    raise OSError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are taken by graphs of this machine")


def _lock(domain: int) -> IO[str] | None:
    """Return an open, locked file, or None if another process holds it."""
    path = Path(tempfile.gettempdir()) / f"mujoban-ros-domain-{domain}-{os.getuid()}.lock"
    file = path.open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
