"""rosbag2 bags without rclpy: write MCAP, read MCAP and sqlite3, notice damage.

with BagWriter("bags/mine", topics) as bag:
    bag.write("/pose", stamp, cdr)

for tick in open_bag("bags/mine").ticks([topics.CAMERA, topics.POSE]):
    frame, pose = tick.values
"""

from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.reader import Bag, BagMessage, Tick, Value, open_bag
from mujoban_msgs_py.bags.recovery import recover_bag
from mujoban_msgs_py.bags.storage import Damage, TopicInfo
from mujoban_msgs_py.bags.types import TypeRegistry
from mujoban_msgs_py.bags.writer import BagWriter

__all__ = [
    "Bag",
    "BagError",
    "BagMessage",
    "BagWriter",
    "Damage",
    "Tick",
    "TopicInfo",
    "TypeRegistry",
    "Value",
    "open_bag",
    "recover_bag",
]
