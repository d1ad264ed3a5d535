"""Beside a genuine `ros2` command, and what an installation tells it of our messages."""

import shutil
import sys
from pathlib import Path

from mujoban_msgs_py import conversions
from mujoban_msgs_py.ros2.main import environment_outside, is_prepared, other_command


def test_the_genuine_command_is_taken_only_if_it_knows_our_messages(tmp_path):
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "std_msgs").touch()
    assert not is_prepared(str(tmp_path), ["topic", "list"])
    (index / "mujoban_msgs").touch()
    assert is_prepared(f"/nowhere:{tmp_path}", ["topic", "list"])
    assert not is_prepared(str(tmp_path), ["bag", "info"]), "rosbag2 is missing"
    (index / "ros2bag").touch()
    assert is_prepared(str(tmp_path), ["bag", "info"])


def test_the_index_of_an_installation_names_our_messages(tmp_path, monkeypatch):
    import ament_index_python

    from mujoban_msgs_py.interface_build import ament_files, generate

    source = Path(conversions.__file__).parent
    generate(source, tmp_path / "build", tmp_path / "python")
    for folder, files in ament_files(source, tmp_path / "build"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.copy(file, tmp_path / folder)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    content, prefix = ament_index_python.get_resource("rosidl_interfaces", "mujoban_msgs")
    assert "msg/Instruction.msg" in content.splitlines() and prefix == str(tmp_path)
    assert all((tmp_path / "share" / "mujoban_msgs" / line).is_file() for line in content.splitlines())
    assert ament_index_python.get_package_share_directory("mujoban_msgs") == str(tmp_path / "share" / "mujoban_msgs")


def test_the_genuine_command_is_found_and_gets_a_clean_environment(tmp_path):
    own, genuine = tmp_path / "own" / "ros2", tmp_path / "opt" / "ros2"
    for file, text in ((own, "from mujoban_msgs_py.ros2.main import main"), (genuine, "from ros2cli import main")):
        file.parent.mkdir()
        file.write_text(text)
        file.chmod(0o755)
    assert other_command(f"{own.parent}:{genuine.parent}", own) == genuine
    assert other_command(f"{own.parent}", Path("elsewhere")) is None
    clean = environment_outside(
        {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "LD_LIBRARY_PATH": f"{sys.prefix}/lib:/opt/ros/lib"}, Path(sys.prefix)
    )
    assert clean == {"LD_LIBRARY_PATH": "/opt/ros/lib"}
