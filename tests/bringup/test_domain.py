"""Two graphs of one machine never share a domain, whoever runs them and whatever TMPDIR says."""

import os

import pytest
from rclpy.context import Context

from bringup.domain import claim_domain
from mujoban_msgs_py.runtime.tick_node import ros_context


def test_each_graph_takes_a_domain_of_its_own(monkeypatch, tmp_path):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with claim_domain() as first:
        monkeypatch.setenv("TMPDIR", str(tmp_path))
        monkeypatch.delenv("ROS_DOMAIN_ID")
        with claim_domain() as second:
            assert first != second and os.environ["ROS_DOMAIN_ID"] == str(second)
        monkeypatch.setenv("ROS_DOMAIN_ID", str(first))


def test_a_domain_that_is_asked_for_and_taken_is_refused(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "99")
    with claim_domain() as domain:
        assert domain == 99
        with pytest.raises(OSError, match="another graph runs in ROS domain 99"), claim_domain():
            pass
    with claim_domain():
        pass


@pytest.mark.parametrize("chosen", ["ninety", "-1", "233"])
def test_what_is_no_domain_is_refused_before_ros_sees_it(monkeypatch, chosen):
    monkeypatch.setenv("ROS_DOMAIN_ID", chosen)
    expected = f"ROS_DOMAIN_ID is '{chosen}': expected a number from 0 to 232"
    with pytest.raises(ValueError, match=expected), claim_domain():
        pass
    with pytest.raises(ValueError, match=expected), ros_context([], Context()):
        pass
