"""Publishes a tick of the world: observation, episode, ground truth, all with one stamp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import Header

from mujoban_core.camera import camera_intrinsics
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.topics import Topic
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec

_NEEDED = (topics.EPISODE, topics.CAMERA, topics.PROPRIO, topics.POSE)
"""What the modules cannot do without."""
GLANCE = 4
"""Ticks between two views from above where all who read it ask for best effort, as those do who only watch."""


class TickLabel(NamedTuple):
    """What names a tick besides the state of the world."""

    stamp: int
    """Simulated time [ns]."""
    episode: int
    """Number of the episode, from 1."""
    difficulty: int
    sequence: int
    """Number of the instruction in force before this tick, 0 for none."""


class ObservationPublisher:
    """Publishes the state of the only row of a world.

    Ground truth and the view from above, which cost time and which no learned module receives, are published
    while somebody subscribes to them; the view from above only now and then while nobody needs all of it.
    """

    def __init__(self, node: Node, world: World, top_camera_size: int) -> None:
        """Make the publishers of `topics.SIMULATOR_TOPICS` on a node."""
        if world.batch != 1:
            raise ValueError(f"world has {world.batch} rows: the graph plays 1")
        self._node = node
        self._world = world
        self._top_camera_size = top_camera_size
        self._joints = list(world.body.joints)
        self._spec: EpisodeSpec | None = None
        self._level_text = ""
        self._intrinsics = camera_intrinsics(world.body.camera)
        self._publishers = {t: node.create_publisher(t.type, t.name, t.qos) for t in topics.SIMULATOR_TOPICS}
        self._composers: dict[Topic, Callable[[TickLabel], Any]] = {
            topics.CLOCK: lambda label: conversions.clock_to_msg(label.stamp),
            topics.EPISODE: self._episode,
            topics.CAMERA: self._camera,
            topics.CAMERA_INFO: self._camera_info,
            topics.PROPRIO: self._proprio,
            topics.POSE: self._pose,
            topics.TRUE_POSE: self._pose,
            topics.TRUE_ABSTRACT_STATE: self._abstract_state,
            topics.TRUE_TWIST: self._twist,
            topics.TRUE_BOXES: self._boxes,
            topics.TRUE_TERMINATION: self._termination,
            topics.TOP_CAMERA: self._top_camera,
        }
        self._on_demand = {*topics.TRUTH_TOPICS, topics.TOP_CAMERA, topics.CAMERA_INFO}
        self._top_readers, self._top_period = 0, 1

    def matched(self, *, everything: bool) -> bool:
        """Tell whether somebody subscribes to what the modules need, or to everything."""
        needed = self._publishers if everything else _NEEDED
        return all(self._publishers[topic].get_subscription_count() for topic in needed)

    def publish(self, label: TickLabel) -> None:
        """Publish the world as it is now."""
        for topic, publisher in self._publishers.items():
            if topic not in self._on_demand or self._is_wanted(topic, label.stamp):
                publisher.publish(self._composers[topic](label))

    def _is_wanted(self, topic: Topic, stamp: int) -> bool:
        readers = self._publishers[topic].get_subscription_count()
        if topic is not topics.TOP_CAMERA or not readers:
            return readers > 0
        if readers != self._top_readers:
            known = self._node.get_subscriptions_info_by_topic(topic.name)
            # Not all may be known yet: then they are looked at again in the next tick.
            self._top_readers = len(known)
            glances = all(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in known)
            self._top_period = GLANCE if glances and len(known) == readers else 1
        return stamp // topics.TICK % self._top_period == 0

    def _episode(self, label: TickLabel) -> Any:
        world = self._world
        spec = world.episodes[0]
        if spec is None:
            raise RuntimeError("no episode has been started")
        if spec is not self._spec:
            self._spec, self._level_text = spec, spec.level.to_text()
        reading = conversions.EpisodeReading(
            episode=label.episode,
            seed=spec.seed,
            difficulty=label.difficulty,
            level=self._level_text,
            step=int(world.steps[0]),
            reward=world.reward[0],
            episode_return=world.episode_return[0],
            solved=bool(world.solved[0]),
            terminated=bool(world.solved[0]),
            truncated=bool(world.truncated[0]),
            boxes_on_target=int(world.box_on_target[0].sum()),
        )
        return conversions.episode_to_msg(conversions.header(label.stamp, topics.MAP_FRAME), reading)

    def _camera(self, label: TickLabel) -> Any:
        return conversions.frame_to_msg(conversions.header(label.stamp, topics.CAMERA_FRAME), self._world.render()[0])

    def _camera_info(self, label: TickLabel) -> Any:
        return conversions.camera_info_to_msg(conversions.header(label.stamp, topics.CAMERA_FRAME), self._intrinsics)

    def _proprio(self, label: TickLabel) -> Any:
        header = conversions.header(label.stamp, topics.BODY_FRAME)
        return conversions.proprio_to_msg(header, self._world.proprio[0], self._joints)

    def _pose(self, label: TickLabel) -> Any:
        return conversions.pose_to_msg(_map_header(label), self._world.pose[0])

    def _abstract_state(self, label: TickLabel) -> Any:
        return conversions.abstract_state_to_msg(_map_header(label), self._world.abstract_state()[0])

    def _twist(self, label: TickLabel) -> Any:
        return conversions.twist_to_msg(_map_header(label), self._world.velocity[0])

    def _boxes(self, label: TickLabel) -> Any:
        present = self._world.box_position[0, : self._world.box_count[0]]
        return conversions.boxes_to_msg(_map_header(label), present)

    def _termination(self, label: TickLabel) -> Any:
        completed = bool(self._world.completed[0])
        return conversions.termination_to_msg(_map_header(label), label.sequence, float(completed), completed)

    def _top_camera(self, label: TickLabel) -> Any:
        frame = self._world.render("top_down", size=self._top_camera_size)[0]
        return conversions.frame_to_msg(conversions.header(label.stamp, topics.TOP_CAMERA_FRAME), frame)


def _map_header(label: TickLabel) -> Header:
    return conversions.header(label.stamp, topics.MAP_FRAME)
