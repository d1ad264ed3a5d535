"""How far nodes reach, by the environment that they find."""

import os
import subprocess
import sys

import psutil
import pytest

from mujoban_msgs_py.runtime import discovery
from mujoban_msgs_py.runtime.discovery import LOOPBACK, PROFILES, RANGE

NODE = """
import time, rclpy
from mujoban_msgs_py.runtime.tick_node import init_ros
init_ros([])
node = rclpy.create_node("lonely")
print("made", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize(
    ("given", "expected", "further"),
    [
        ({}, {RANGE: "SYSTEM_DEFAULT", PROFILES: str(LOOPBACK)}, False),
        ({RANGE: "LOCALHOST"}, {RANGE: "LOCALHOST"}, False),
        ({RANGE: "SUBNET"}, {RANGE: "SUBNET"}, True),
        ({RANGE: "SYSTEM_DEFAULT"}, {RANGE: "SYSTEM_DEFAULT"}, True),
        ({PROFILES: "mine.xml"}, {PROFILES: "mine.xml", RANGE: "LOCALHOST"}, True),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, {RANGE: "LOCALHOST"}, False),
    ],
)
def test_nodes_stay_on_this_host_and_what_the_environment_says_is_left_alone(monkeypatch, given, expected, further):
    environment = dict(given)
    monkeypatch.setattr(discovery.os, "environ", environment)
    before = discovery.reaches_further()
    discovery.confine_discovery()
    assert environment == given | expected
    assert (before, discovery.reaches_further()) == (further, further)


def test_a_node_listens_on_the_loopback_interface_alone_and_keeps_nothing_in_shared_memory():
    environment = {k: v for k, v in os.environ.items() if k not in (RANGE, PROFILES)}
    with subprocess.Popen([sys.executable, "-c", NODE], env=environment, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None and child.stdout.readline() == "made\n"
            process = psutil.Process(child.pid)
            sockets = {c.laddr.ip for c in process.net_connections("inet") if c.laddr}
            mapped = [m.path for m in process.memory_maps() if m.path.startswith("/dev/shm/fastrtps")]
        finally:
            child.kill()
    assert sockets == {"127.0.0.1"} and mapped == []
