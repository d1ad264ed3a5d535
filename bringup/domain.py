"""Keep two graphs on one machine apart: each takes a ROS domain of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from mujoban_msgs_py.runtime.discovery import DOMAIN, chosen_domain, lock_domain

DOMAINS = range(102)
"""Domains that Linux's ephemeral ports do not reach into."""


@contextmanager
def claim_domain() -> Iterator[int]:
    """Hold a ROS domain while a graph runs, and name it in the environment.

    `ROS_DOMAIN_ID` decides where it is set. Otherwise the first domain is taken that no other graph of this
    machine holds, whoever runs it, nor a simulator that was started alone.

    Raises:
        ValueError: If `ROS_DOMAIN_ID` is no domain.
        OSError: If another graph runs in that domain, or in all of them.
    """
    chosen = chosen_domain()
    if chosen is not None:
        lock = lock_domain(chosen)
        if lock is None:
            raise OSError(
                f"another graph runs in ROS domain {chosen} on this machine, and the two would mix: "
                f"expected another {DOMAIN}, or none"
            )
        with lock:
            yield chosen
        return
    for domain in DOMAINS:
        lock = lock_domain(domain)
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
