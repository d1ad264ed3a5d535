"""What nodes make of the arguments of ROS: names that are changed, parameters that there are not."""

import time

from rclpy.context import Context
from rclpy.qos import QoSPresetProfiles
from sensor_msgs.msg import Image

from bringup.graph import InProcess
from bringup.parameters import graph_parameters
from mujoban_msgs_py import topics
from mujoban_msgs_py.runtime.tick_node import ros_context
from mujoban_sim.observation import GLANCE
from mujoban_sokoban.episodes import Episodes


def test_a_graph_whose_topics_are_renamed_plays_and_knows_who_only_watches(oracles):
    renamed = {topics.TORQUE: "/arm/torque", topics.INSTRUCTION: "/arm/instruction", topics.TOP_CAMERA: "/above"}
    rules = [word for topic, name in renamed.items() for word in ("-r", f"{topic.name}:={name}")]
    context = Context()
    parameters = graph_parameters(oracles, Episodes(1, 47, difficulty=2))
    with ros_context(["--ros-args", *rules], context), InProcess(parameters, context=context) as graph:
        simulator = graph.nodes["simulator"]
        simulator.create_subscription(Image, "/above", lambda _: None, QoSPresetProfiles.SENSOR_DATA.value)
        deadline = time.monotonic() + 60
        while simulator.ticks < 3 or simulator._observation._top_period != GLANCE:
            assert time.monotonic() < deadline, "the simulator waits for answers on names that are not theirs"
            graph.executor.spin_once(timeout_sec=0.05)
        assert simulator.count_publishers("/arm/torque") == 1 and not simulator.count_publishers("/torque")
