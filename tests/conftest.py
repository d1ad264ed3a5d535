"""What all tests share: a private ROS domain on this host, checked message fields, one software-rendering thread."""

import os

# Before anything imports ROS or MuJoCo.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("LP_NUM_THREADS", "0")

import pytest


@pytest.fixture
def ros():
    """Run a test with rclpy initialised."""
    import rclpy

    rclpy.init()
    yield rclpy
    rclpy.try_shutdown()
