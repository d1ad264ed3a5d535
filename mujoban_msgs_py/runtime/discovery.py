"""How far nodes reach: this host alone and its ROS domain 0, unless the environment says otherwise."""

from __future__ import annotations

import errno
import os
import re
import socket
from pathlib import Path
from typing import Final

RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
DOMAIN: Final = "ROS_DOMAIN_ID"
PROFILES: Final = "FASTRTPS_DEFAULT_PROFILES_FILE"
LOOPBACK: Final = Path(__file__).with_name("loopback.xml")
HIGHEST_DOMAIN: Final = 232
"""Beyond it there are no ports left for a domain: Fast DDS would end the process."""
_PORTS_OF_A_DOMAIN: Final = 250
"""UDP ports of each domain, from 7400 on; its participants have the even ones from the tenth on (DDSI-RTPS)."""
_LOCK: Final = "mujoban-ros-domain-"
_FAST_DDS: Final = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


def chosen_domain() -> int | None:
    """Return the ROS domain that the environment names, or None where it names none.

    Raises:
        ValueError: If that is no domain.
    """
    chosen = os.environ.get(DOMAIN)
    if not chosen:
        return None
    if not (chosen.isdecimal() and int(chosen) <= HIGHEST_DOMAIN):
        raise ValueError(f"{DOMAIN} is {chosen!r}: expected a number from 0 to {HIGHEST_DOMAIN}")
    return int(chosen)


def reaches_further() -> bool:
    """Tell whether nodes may reach beyond this host, by the environment before or after `confine_discovery`."""
    confined = {"LOCALHOST", "SYSTEM_DEFAULT"} if PROFILES in os.environ else {"LOCALHOST"}
    ours = os.environ.get(PROFILES, str(LOOPBACK)) == str(LOOPBACK)
    return not (ours and os.environ.get(RANGE, "LOCALHOST") in confined)


def confine_discovery() -> None:
    """Keep ROS on this host's loopback interface, for child processes as well; call before rclpy is initialised.

    A range, or a profile of Fast DDS, that the environment names is left as it is. Without Fast DDS the range is
    `LOCALHOST`, as each middleware understands it.
    """
    if RANGE in os.environ:
        return
    ours = os.environ.get("RMW_IMPLEMENTATION", _FAST_DDS[0]) in _FAST_DDS and PROFILES not in os.environ
    if ours:
        os.environ[PROFILES] = str(LOOPBACK)
    # To Fast DDS, the system's default is what the profile says; `LOCALHOST` would add transports of its own to it.
    os.environ[RANGE] = "SYSTEM_DEFAULT" if ours else "LOCALHOST"


def lock_domain(domain: int) -> socket.socket | None:
    """Return what holds a domain until it is closed, or None if another process holds it.

    It is a socket's name in Linux's abstract namespace: one for all users of a machine, in no folder, and free as soon
    as the process that holds it has ended.
    """
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        holder.bind(f"\0{_LOCK}{domain}")
    except OSError as error:
        holder.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return holder


def held_domains() -> list[int]:
    """Return the ROS domains that graphs of this machine hold."""
    held = re.findall(rf"@{_LOCK}(\d+)$", "\n".join(_lines(Path("/proc/net/unix"))), re.MULTILINE)
    return sorted({int(domain) for domain in held})


def is_alone(domain: int) -> bool:
    """Tell whether the one participant that this process has in a ROS domain is the only one that can be met there.

    It looks for the ports of others. Where nodes may reach beyond this host, or speak through other than Fast DDS,
    nobody can tell.
    """
    if reaches_further() or os.environ.get("RMW_IMPLEMENTATION", _FAST_DDS[0]) not in _FAST_DDS:
        return False
    lines = [line.split() for name in ("udp", "udp6") for line in _lines(Path("/proc/net", name))]
    ports = {int(fields[1].rpartition(":")[2], 16) for fields in lines}
    first = 7400 + _PORTS_OF_A_DOMAIN * domain
    return len(ports & {*range(first + 10, first + _PORTS_OF_A_DOMAIN, 2)}) == 1


def _lines(table: Path) -> list[str]:
    """Return the lines of a table of sockets, none where the kernel has none; names in it may be any bytes."""
    return table.read_text(errors="replace").splitlines()[1:] if table.exists() else []
