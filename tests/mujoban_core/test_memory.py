"""How much memory there is to take."""

from __future__ import annotations

from pathlib import Path

import pytest

from mujoban_core.memory import available_memory


def group(folder: Path, most: str, used: int) -> Path:
    (folder / "memory.max").write_text(f"{most}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    return folder


@pytest.mark.parametrize(
    ("most", "used", "expected"), [("max", 10**9, 4_096_000), ("3000000", 1_000_000, 2_000_000), ("1000", 2000, 0)]
)
def test_a_control_group_may_leave_less_than_the_machine_has(
    tmp_path: Path, most: str, used: int, expected: int
) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:  9000 kB\nMemAvailable:    4000 kB\nBuffers: 1 kB\n")
    assert available_memory(meminfo, group(tmp_path, most, used)) == expected


@pytest.mark.parametrize("version", [1, 2])
def test_files_that_a_group_has_cached_are_free_to_take(tmp_path: Path, version: int) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemAvailable:    4000 kB\n")
    if version == 2:
        (group(tmp_path, "3000000", 2_900_000) / "memory.stat").write_text("file 9\ninactive_file 1500000\n")
    else:
        folder = tmp_path / "memory"
        folder.mkdir()
        (folder / "memory.limit_in_bytes").write_text("3000000\n")
        (folder / "memory.usage_in_bytes").write_text("2900000\n")
        (folder / "memory.stat").write_text("inactive_file 9\ntotal_inactive_file 1500000\n")
    assert available_memory(meminfo, tmp_path) == 1_600_000


def test_this_machine_has_some() -> None:
    assert available_memory() > 2**20
