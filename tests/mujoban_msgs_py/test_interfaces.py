"""The generated interface package and the table of topics."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mujoban_msgs import msg
from rclpy.serialization import deserialize_message, serialize_message

from mujoban_core.grid import CHANNELS, Instruction
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import TypeRegistry

MESSAGES = sorted(p.stem for p in (Path(__file__).parents[2] / "mujoban_msgs_py" / "msg").glob("*.msg"))


@pytest.mark.parametrize("name", MESSAGES)
def test_every_message_survives_the_wire(name):
    kind = getattr(msg, name)
    message = kind()
    message.header = conversions.header(12_345_678_901, "map")
    assert deserialize_message(serialize_message(message), kind) == message


def test_instruction_constants_follow_the_grid():
    for direction in Instruction:
        assert getattr(msg.Instruction, direction.name) == direction.value


def test_abstract_state_layers_follow_the_grid():
    assert set(CHANNELS) <= set(msg.AbstractState.get_fields_and_field_types())


@pytest.mark.parametrize("name", MESSAGES)
def test_definitions_written_to_bags_have_the_hash_that_the_graph_announces(ros, name):
    type_name = f"mujoban_msgs/msg/{name}"
    node = ros.create_node("announcer")
    node.create_publisher(getattr(msg, name), "/announced", 1)
    (info,) = node.get_publishers_info_by_topic("/announced")
    assert str(info.topic_type_hash) == TypeRegistry().type_hash(type_name)
    node.destroy_node()


def test_latched_topics_reach_late_joiners_and_all_are_reliable():
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    for topic in topics.GRAPH_TOPICS.values():
        assert topic.qos.reliability == ReliabilityPolicy.RELIABLE
    latched = {t.name for t in topics.GRAPH_TOPICS.values() if t.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL}
    assert latched == {"/episode", "/ground_truth/episode", "/instruction"}


def test_reading_bags_and_converting_need_no_rclpy():
    code = "import sys, mujoban_msgs_py.bags, mujoban_msgs_py.conversions; sys.exit('rclpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_imports_from_any_directory(tmp_path):
    code = "import mujoban_msgs.msg, mujoban_sim, bringup"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 0


def test_one_tick_is_a_control_period():
    assert topics.TICK == 50_000_000 and np.isclose(topics.TICK / 1e9, 0.05)
