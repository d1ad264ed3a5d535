"""What a process that trains does with the memory that it frees."""

from __future__ import annotations

import subprocess
import sys

_SIZE = 28_000_000
"""Bytes of an activation."""
_KEPT = """
from pathlib import Path
import torch
from mujoban_rl.memory import keep_freed_memory

if {keeps}:
    keep_freed_memory()
def resident():
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])
torch.ones(1)
before = resident()
activation = torch.ones({size} // 4)
del activation
print(resident() - before)
"""


def bytes_kept(keeps: bool) -> int:
    """Return how much a process has grown by an activation that it has freed."""
    program = _KEPT.format(keeps=keeps, size=_SIZE)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_what_an_update_frees_stays_with_the_process():
    assert bytes_kept(keeps=True) > 0.9 * _SIZE
    assert bytes_kept(keeps=False) < 0.5 * _SIZE, "it goes back to the kernel by itself"
