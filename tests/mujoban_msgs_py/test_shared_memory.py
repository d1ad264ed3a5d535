"""What Fast DDS leaves in shared memory is cleared, what is in use is not."""

import fcntl
import os
import subprocess
import sys

import pytest
import rclpy

from mujoban_msgs_py.runtime.discovery import RANGE
from mujoban_msgs_py.runtime.shared_memory import FOLDER, RunFolder, clear_shared_memory, mapped_segments
from mujoban_msgs_py.runtime.tick_node import init_ros, ros_context

SEGMENT = "fastrtps_0123456789abcdef"


def test_only_what_nobody_holds_is_removed(tmp_path):
    left = [SEGMENT, SEGMENT + "_el", "fastrtps_port64999", "sem.fastrtps_port64999_mutex"]
    for name in (*left, "psm_0123", "fastrtps_x"):
        (tmp_path / name).write_bytes(b"")
    held = "fastrtps_fedcba9876543210"
    (tmp_path / held).write_bytes(b"")
    with (tmp_path / f"{held}_el").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with (tmp_path / "fastrtps_port64998").open("wb"):
            removed = clear_shared_memory(tmp_path)
    assert sorted(removed) == sorted(left)
    kept = [held, f"{held}_el", "fastrtps_port64998", "fastrtps_x", "psm_0123"]
    assert sorted(os.listdir(tmp_path)) == kept


def test_the_folder_of_a_run_that_was_killed_is_removed_and_that_of_one_that_lives_is_not(tmp_path):
    code = "import sys; from mujoban_msgs_py.runtime.shared_memory import *; r = RunFolder(Path(sys.argv[1])); "
    code += "os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == -9
    lives = RunFolder(tmp_path)
    (lives.path / "kept").write_text("memory")
    (orphan,) = set(tmp_path.iterdir()) - {lives.path}
    assert clear_shared_memory(tmp_path) == [orphan.name]
    assert (lives.path / "kept").exists()
    lives.remove()
    assert not list(tmp_path.iterdir())


def test_a_node_that_nobody_can_destroy_any_more_leaves_nothing(ros, monkeypatch):
    monkeypatch.setenv(RANGE, "LOCALHOST")  # as Fast DDS understands it, with shared memory
    alive, context = rclpy.Context(), rclpy.Context()
    init_ros([], alive)
    others = rclpy.create_node("other", context=alive)
    before = mapped_segments()
    with pytest.raises(KeyboardInterrupt), ros_context(context=context):
        half_made = ros.create_node("half_made", context=context)
        held = mapped_segments()
        raise KeyboardInterrupt
    ours = {name for name in held - before if "port" not in name}  # another program's test may use the same port
    assert ours and before and all((FOLDER / name).exists() for name in before)
    assert not [name for name in ours if (FOLDER / name).exists()]
    half_made.destroy_node()
    others.destroy_node()
    alive.try_shutdown()
