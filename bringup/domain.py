"""Keep two graphs on one machine apart: each takes a ROS domain of its own."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from mujoban_msgs_py.runtime.discovery import DOMAIN, chosen_domain

DOMAINS = range(102)
"""Domains that Linux's ephemeral ports do not reach into."""


@contextmanager
def claim_domain() -> Iterator[int]:
    """Hold a ROS domain while a graph runs, and name it in the environment.

    `ROS_DOMAIN_ID` decides where it is set. Otherwise the first domain is taken that no other graph of this
    machine holds, whoever runs it.

    Raises:
        ValueError: If `ROS_DOMAIN_ID` is no domain.
        OSError: If another graph runs in that domain, or in all of them.
    """
    chosen = chosen_domain()
    if chosen is not None:
        lock = _lock(chosen)
        if lock is None:
            raise OSError(
                f"another graph runs in ROS domain {chosen} on this machine, and the two would mix: "
                f"expected another {DOMAIN}, or none"
            )
        with lock:
            yield chosen
        return
    for domain in DOMAINS:
        lock = _lock(domain)
        if lock is None:
            continue
        if domain != 0:
            print(f"another graph runs on this machine: using {DOMAIN}={domain}", file=sys.stderr)
        os.environ[DOMAIN] = str(domain)
        try:
            with lock:
                yield domain
        finally:
            del os.environ[DOMAIN]
        return
    raise OSError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are taken by graphs of this machine")


def _lock(domain: int) -> socket.socket | None:
    """Return what holds a domain until it is closed, or None if another process holds it.

    It is a socket's name in Linux's abstract namespace: one for all users of a machine, in no folder, and free as soon
    as the process that holds it has ended.
    """
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        holder.bind(f"\0mujoban-ros-domain-{domain}")
    except OSError as error:
        holder.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return holder
