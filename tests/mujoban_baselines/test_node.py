import numpy as np
import pytest
from rclpy.parameter import Parameter

from mujoban_baselines.node import AgentNode
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import ConversionError


@pytest.fixture
def node(ros):
    node = AgentNode(parameter_overrides=[Parameter("module", value="random")])
    yield node
    node.destroy_node()


def test_a_view_from_above_of_another_size_than_agents_see_is_refused(node):
    node.check(topics.TOP_CAMERA, np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(ConversionError, match=r"o_top must have shape \[64, 64, 3\], got \[128, 128, 3\]"):
        node.check(topics.TOP_CAMERA, np.zeros((128, 128, 3), np.uint8))
