"""How far nodes reach, by the environment that they find."""

import os
import re
import socket
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
DOMAIN = 102 + os.getpid() % 100
"""Which no other test uses."""


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


def test_who_is_alone_in_a_domain_knows_it_and_where_graphs_run(monkeypatch):
    monkeypatch.setenv(discovery.DOMAIN, str(DOMAIN))
    for variable in (RANGE, PROFILES):
        monkeypatch.delenv(variable, raising=False)
    command = [sys.executable, "-m", "mujoban_msgs_py.ros2.main", "node", "list"]
    graph = discovery.lock_domain(DOMAIN + 100)
    alone = subprocess.run(command, capture_output=True, text=True, check=True)
    assert alone.stdout == "" and f"nobody else is in ROS domain {DOMAIN} of this machine, but" in alone.stderr
    assert DOMAIN + 100 in map(int, re.findall(r"\d+", alone.stderr))
    graph.close()
    with subprocess.Popen([sys.executable, "-c", NODE], stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None and child.stdout.readline() == "made\n"
            met = subprocess.run(command, capture_output=True, text=True, check=True)
        finally:
            child.kill()
    assert met.stdout == "/lonely\n" and met.stderr == ""


def test_sockets_of_others_may_have_names_that_are_no_text():
    with socket.socket(socket.AF_UNIX) as other, discovery.lock_domain(DOMAIN + 100):
        other.bind(b"\0\xff\xfe" + str(os.getpid()).encode())
        assert DOMAIN + 100 in discovery.held_domains()


@pytest.mark.parametrize(("variable", "value"), [(RANGE, "SUBNET"), ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")])
def test_who_cannot_know_of_others_does_not_call_itself_alone(monkeypatch, variable, value):
    monkeypatch.delenv(PROFILES, raising=False)
    monkeypatch.setattr(discovery, "_lines", lambda table: [f"0: 0100007F:{7410 + 250 * DOMAIN:04X} 00000000:0000 07"])
    monkeypatch.setenv(RANGE, "LOCALHOST")
    assert discovery.is_alone(DOMAIN)
    monkeypatch.setenv(variable, value)
    assert not discovery.is_alone(DOMAIN)
