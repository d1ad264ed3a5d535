"""How much memory a process may take (Linux)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

_MEMINFO: Final = Path("/proc/meminfo")
_CGROUP: Final = Path("/sys/fs/cgroup")
_FILES: Final = (
    (".", "memory.max", "memory.current", "inactive_file"),
    ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Folder, limit, what is used, and the entry of `memory.stat` for cached files, of control groups' versions 2 and 1."""


def available_memory(meminfo: Path = _MEMINFO, cgroup: Path = _CGROUP) -> int:
    """Return the bytes that are free to take: on the machine, or in the control group where that has fewer.

    What a group's cache of files holds and has not used lately counts as free, as the machine's does.

    Args:
        meminfo: Where the kernel says what the machine has.
        cgroup: Folder of the control group, of version 2, or one that has `memory`, of version 1.

    Raises:
        OSError: If the kernel does not say.
    """
    found = re.search(r"^MemAvailable:\s+(\d+) kB$", meminfo.read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"{meminfo}: expected a line MemAvailable")
    free = 1024 * int(found[1])
    for folder, limit, used, cached in _FILES:
        file = cgroup / folder / limit
        if file.is_file() and (most := file.read_text().strip()) != "max":
            taken = int((cgroup / folder / used).read_text())
            free = min(free, int(most) - taken + _inactive(cgroup / folder / "memory.stat", cached))
    return max(0, free)


def _inactive(statistics: Path, entry: str) -> int:
    """Return the bytes of cached files that were not used lately; 0 if the group does not say."""
    found = re.search(rf"^{entry} (\d+)$", statistics.read_text(), re.MULTILINE) if statistics.is_file() else None
    return 0 if found is None else int(found[1])
