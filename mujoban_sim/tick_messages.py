"""What the simulator says of one robot in a tick, as messages: the same in the graph and in recorded rollouts.

Nothing here needs rclpy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseArray
from mujoban_msgs.msg import Episode
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from mujoban_core.bodies import Body
from mujoban_core.camera import camera_intrinsics
from mujoban_core.grid import BOX, TARGET
from mujoban_core.interfaces import GroundTruth, Observation
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.adapted import Adapted, message_of
from mujoban_msgs_py.checks import finite
from mujoban_msgs_py.topics import Message, Topic
from mujoban_sokoban.episodes import EpisodeSpec

_header = lru_cache(maxsize=8)(conversions.header)
"""Makes a header once for all messages of a tick in its frame, which leave it as it is."""


class TickLabel(NamedTuple):
    """What names a tick besides the state of the world."""

    stamp: int
    """Simulated time [ns]."""
    episode: int
    """Number of the episode, from 1."""
    difficulty: int
    sequence: int
    """Number of the instruction in force before this tick, 0 for none."""


class EpisodeProgress(NamedTuple):
    """How far an episode is."""

    spec: EpisodeSpec
    step: int
    """Steps so far."""
    reward: float
    """Of the step before."""
    episode_return: float
    solved: bool
    truncated: bool


class SimulatorTick(NamedTuple):
    """One tick of the robot in row `row` of a batch."""

    label: TickLabel
    progress: EpisodeProgress
    observation: Observation
    truth: GroundTruth
    row: int


class TickComposer:
    """Composes the messages of `topics.SIMULATOR_TOPICS`, but for the view from above."""

    def __init__(self, body: Body) -> None:
        """Compose for robots of a body."""
        self._joints = list(body.joints)
        self._intrinsics = camera_intrinsics(body.camera)
        self._spec: EpisodeSpec | None = None
        self._level_text = ""
        self._composers: dict[Topic, Callable[[SimulatorTick], Message | Adapted]] = {
            topics.CLOCK: lambda tick: conversions.clock_to_msg(tick.label.stamp),
            topics.EPISODE: self._episode,
            topics.CAMERA: self._camera,
            topics.CAMERA_INFO: self._camera_info,
            topics.PROPRIO: self._proprio,
            topics.POSE: lambda tick: _pose(tick, tick.observation.pose),
            topics.TRUE_ABSTRACT_STATE: self._abstract_state,
            topics.TRUE_POSE: lambda tick: _pose(tick, tick.truth.pose),
            topics.TRUE_TWIST: lambda tick: conversions.twist_to_msg(_map(tick), tick.truth.velocity[tick.row]),
            topics.TRUE_BOXES: self._boxes,
            topics.TRUE_TERMINATION: self._termination,
            topics.TRUE_EPISODE: self._true_episode,
        }
        self.topics = tuple(self._composers)
        """In the order in which the simulator speaks."""

    def say(self, topic: Topic, tick: SimulatorTick) -> Message | Adapted:
        """Return what is said on a topic: of what every robot perceives, and of the true state, copies of the values.

        Raises:
            KeyError: If it is not one of `topics`.
            ConversionError: If the tick holds what the message cannot carry.
        """
        return self._composers[topic](tick)

    def compose(self, topic: Topic, tick: SimulatorTick) -> Message:
        """Return the message of a topic; it raises what `say` does."""
        return message_of(self.say(topic, tick))

    def _episode(self, tick: SimulatorTick) -> Episode:
        progress = tick.progress
        reading = conversions.EpisodeReading(tick.label.episode, progress.step, progress.solved or progress.truncated)
        return conversions.episode_to_msg(_map(tick), reading)

    def _true_episode(self, tick: SimulatorTick) -> Adapted:
        label, progress = tick.label, tick.progress
        if progress.spec is not self._spec:
            self._spec, self._level_text = progress.spec, progress.spec.level.to_text()
        state = tick.truth.abstract_state[tick.row]
        reading = conversions.EpisodeTruthReading(
            episode=label.episode,
            seed=progress.spec.seed,
            difficulty=label.difficulty,
            level=self._level_text,
            step=progress.step,
            reward=progress.reward,
            episode_return=progress.episode_return,
            solved=progress.solved,
            terminated=progress.solved,
            truncated=progress.truncated,
            boxes_on_target=int(np.vdot(state[..., BOX], state[..., TARGET])),
        )
        to_msg = partial(conversions.episode_truth_to_msg, _map(tick))
        return Adapted(label.stamp, conversions.episode_truth_value(reading), to_msg)

    def _camera(self, tick: SimulatorTick) -> Adapted:
        header = _header(tick.label.stamp, topics.CAMERA_FRAME)
        frame = tick.observation.frame[tick.row].copy()
        return Adapted(tick.label.stamp, frame, partial(conversions.frame_to_msg, header))

    def _camera_info(self, tick: SimulatorTick) -> CameraInfo:
        header = _header(tick.label.stamp, topics.CAMERA_FRAME)
        return conversions.camera_info_to_msg(header, self._intrinsics)

    def _proprio(self, tick: SimulatorTick) -> Adapted:
        to_msg = partial(
            conversions.proprio_to_msg, _header(tick.label.stamp, topics.BODY_FRAME), joints=self._joints
        )
        proprio = finite("proprio", tick.observation.proprio[tick.row], (None,), np.float32)
        return Adapted(tick.label.stamp, proprio, to_msg)

    def _abstract_state(self, tick: SimulatorTick) -> Adapted:
        to_msg = partial(conversions.abstract_state_to_msg, _map(tick))
        return Adapted(tick.label.stamp, conversions.abstract_state_value(tick.truth.abstract_state[tick.row]), to_msg)

    def _boxes(self, tick: SimulatorTick) -> PoseArray:
        present = tick.truth.box_position[tick.row, : len(tick.progress.spec.level.boxes)]
        return conversions.boxes_to_msg(_map(tick), present)

    def _termination(self, tick: SimulatorTick) -> Adapted:
        completed = bool(tick.truth.completed[tick.row])
        value = conversions.termination_value(tick.label.sequence, float(completed), completed)
        return Adapted(tick.label.stamp, value, partial(conversions.termination_to_msg, _map(tick)))


def _pose(tick: SimulatorTick, pose: NDArray[np.float32]) -> Adapted:
    value = finite("pose", pose[tick.row], (3,), np.float32)
    return Adapted(tick.label.stamp, value, partial(conversions.pose_to_msg, _map(tick)))


def _map(tick: SimulatorTick) -> Header:
    return _header(tick.label.stamp, topics.MAP_FRAME)
