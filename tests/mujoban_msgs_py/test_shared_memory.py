"""What Fast DDS leaves in shared memory is cleared, what is in use is not."""

import fcntl
import os

from mujoban_msgs_py.runtime.shared_memory import clear_shared_memory

SEGMENT = "fastrtps_0123456789abcdef"


def test_only_what_nobody_holds_is_removed(tmp_path):
    left = [SEGMENT, SEGMENT + "_el", "fastrtps_port7411", "sem.fastrtps_port7411_mutex"]
    for name in (*left, "psm_0123", "fastrtps_x"):
        (tmp_path / name).write_bytes(b"")
    held = "fastrtps_fedcba9876543210"
    (tmp_path / held).write_bytes(b"")
    with (tmp_path / f"{held}_el").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with (tmp_path / "fastrtps_port7412").open("wb"):
            removed = clear_shared_memory(tmp_path)
    assert sorted(removed) == sorted(left)
    kept = [held, f"{held}_el", "fastrtps_port7412", "fastrtps_x", "psm_0123"]
    assert sorted(os.listdir(tmp_path)) == kept
