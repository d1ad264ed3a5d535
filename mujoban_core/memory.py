"""How much memory a process may take (Linux)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

_MEMINFO: Final = Path("/proc/meminfo")
_CGROUP: Final = Path("/sys/fs/cgroup")


def available_memory(meminfo: Path = _MEMINFO, cgroup: Path = _CGROUP) -> int:
    """Return the bytes that are free to take: on the machine, or in the control group where that has fewer.

    Args:
        meminfo: Where the kernel says what the machine has.
        cgroup: Folder of the control group.

    Raises:
        OSError: If the kernel does not say.
    """
    found = re.search(r"^MemAvailable:\s+(\d+) kB$", meminfo.read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"{meminfo}: expected a line MemAvailable")
    free = 1024 * int(found[1])
    limit = cgroup / "memory.max"
    if limit.is_file() and (most := limit.read_text().strip()) != "max":
        free = min(free, int(most) - int((cgroup / "memory.current").read_text()))
    return max(0, free)
