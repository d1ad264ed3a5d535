"""What all tests share: a private ROS domain on loopback, checked message fields, one thread for numbers and images."""

import os
import sys
from pathlib import Path

# Before anything imports ROS or MuJoCo.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "0")

import pytest
from hypothesis import HealthCheck, settings

from mujoban_core.threads import set_threads
from mujoban_msgs_py.runtime.discovery import PROFILES, RANGE, confine_discovery

# Before ROS is initialised, here or in a child process.
for name in (RANGE, PROFILES):
    os.environ.pop(name, None)
confine_discovery()
# Tests run beside each other, and threads of one network that wait for each other on busy cores take all of these.
set_threads(1)

# How long a machine takes that has other work is no finding.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

IMPORTABLE = str(Path(__file__).parent / "importable")
"""Where worker processes import from what tests let them do."""
sys.path.append(IMPORTABLE)


@pytest.fixture(autouse=True)
def _one_thread():
    """Undo what a command that was run in this process made of the number of threads."""
    yield
    set_threads(1)


@pytest.fixture
def ros():
    """Run a test with rclpy initialised."""
    import rclpy

    rclpy.init()
    yield rclpy
    rclpy.try_shutdown()


@pytest.fixture(scope="session")
def ray_cluster():
    """Run tests on a Ray cluster of this machine with room for two actors."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'mujoban[cluster]'")
    from mujoban_rl.actors.cluster import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([IMPORTABLE, os.environ.get("PYTHONPATH", "")]))
        cluster = Cluster(cpus=2)
        yield cluster
        cluster.close()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder in the place of that of the results, without any."""
    from benchmarks.paper import parts, runs

    monkeypatch.setattr(runs, "JSON", tmp_path / "json")
    monkeypatch.setattr(parts, "PARTS", tmp_path / "parts")
    (tmp_path / "json").mkdir()
    return tmp_path
