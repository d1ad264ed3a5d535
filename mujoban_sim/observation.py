"""Publishes a tick of the world: observation, episode, ground truth, all with one stamp."""

from __future__ import annotations

from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Image

from mujoban_core.interfaces import GroundTruth, Observation
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.topics import Topic
from mujoban_sim.tick_messages import EpisodeProgress, SimulatorTick, TickComposer, TickLabel
from mujoban_sim.world import World

_NEEDED = (topics.EPISODE, topics.CAMERA, topics.PROPRIO, topics.POSE)
"""What the modules cannot do without."""
GLANCE = 4
"""Ticks between two views from above where all who read it ask for best effort, as those do who only watch."""


class ObservationPublisher:
    """Publishes the state of the only row of a world.

    What no learned module receives costs time as well: it is published while somebody subscribes to it; the view from
    above only now and then while nobody needs all of it.
    """

    def __init__(self, node: GraphNode, world: World, top_camera_size: int) -> None:
        """Make the publishers of `topics.SIMULATOR_TOPICS` on a node."""
        if world.batch != 1:
            raise ValueError(f"world has {world.batch} rows: the graph plays 1")
        self._node = node
        self._world = world
        self._top_camera_size = top_camera_size
        self._composer = TickComposer(world.body)
        self._publishers = {topic: node.create_output(topic) for topic in topics.SIMULATOR_TOPICS}
        self._on_demand = {*topics.SIMULATOR_TOPICS} - {*_NEEDED, topics.TRUE_EPISODE}
        self._top_readers, self._top_period = 0, 1

    def matched(self, *, everything: bool) -> bool:
        """Tell whether somebody hears what the modules need, or everything."""
        needed = self._publishers if everything else _NEEDED
        return all(self._publishers[topic].subscriptions for topic in needed)

    def publish(self, label: TickLabel) -> None:
        """Publish the world as it is now."""
        tick = self._tick(label)
        for topic, publisher in self._publishers.items():
            if topic in self._on_demand and not self._is_wanted(topic, label.stamp):
                continue
            said = self._top_camera(label) if topic is topics.TOP_CAMERA else self._composer.say(topic, tick)
            publisher.publish(said)

    def _tick(self, label: TickLabel) -> SimulatorTick:
        world = self._world
        (spec,) = world.episodes
        if spec is None:
            raise RuntimeError("no episode has been started")
        progress = EpisodeProgress(
            spec, int(world.steps[0]), world.reward[0], world.episode_return[0],
            bool(world.solved[0]), bool(world.truncated[0]),
        )  # fmt: skip
        # Live arrays will do: what is said of them are copies.
        observation = Observation(world.render(), world.proprio, world.pose)
        truth = GroundTruth(world.abstract_state(), world.pose, world.velocity, world.box_position, world.completed)
        return SimulatorTick(label, progress, observation, truth, 0)

    def _is_wanted(self, topic: Topic, stamp: int) -> bool:
        readers = self._publishers[topic].subscriptions
        if topic is not topics.TOP_CAMERA:
            return readers > 0
        if not readers:
            self._top_readers = 0  # whoever comes next may want more
            return False
        if readers != self._top_readers:
            known = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(topic.name))
            # Not all may be known yet: then they are looked at again in the next tick.
            self._top_readers = len(known)
            glances = all(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in known)
            self._top_period = GLANCE if glances and len(known) == readers else 1
        return stamp // topics.TICK % self._top_period == 0

    def _top_camera(self, label: TickLabel) -> Image:
        frame = self._world.render("top_down", size=self._top_camera_size)[0]
        return conversions.frame_to_msg(conversions.header(label.stamp, topics.TOP_CAMERA_FRAME), frame)
