"""The node that watches the graph: outcomes of episodes, and the tick that a view shows."""

from __future__ import annotations

import time
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from mujoban_msgs.msg import AbstractState, Episode, Instruction, Termination
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.task import Future

from bringup.failure import EpisodeLog
from bringup.results import EpisodeResult
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.raw import raw_stamp, read
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_msgs_py.synchroniser import Synchroniser

_WATCHED = (topics.INSTRUCTION, topics.TERMINATION, topics.ABSTRACT_STATE, topics.TRUE_ABSTRACT_STATE)


class Watched(NamedTuple):
    """What the modules said in the latest tick; decoded where it is looked at."""

    raw: dict[str, bytes]
    """Topic name -> message."""

    @property
    def instruction(self) -> conversions.InstructionReading:
        """A."""
        return read(self.raw[topics.INSTRUCTION.name], Instruction, conversions.instruction_from_msg)

    @property
    def termination(self) -> conversions.TerminationReading:
        """Beta."""
        return read(self.raw[topics.TERMINATION.name], Termination, conversions.termination_from_msg)

    @property
    def estimate(self) -> NDArray[np.float32]:
        """Estimated abstract state, [N, N, 4]."""
        return read(self.raw[topics.ABSTRACT_STATE.name], AbstractState, conversions.abstract_state_from_msg)

    @property
    def truth(self) -> NDArray[np.float32]:
        """True abstract state, [N, N, 4]."""
        return read(self.raw[topics.TRUE_ABSTRACT_STATE.name], AbstractState, conversions.abstract_state_from_msg)


class MonitorNode(Node):
    """Turns the graph's messages into outcomes of episodes, as `bringup.rollout` does with its ticks.

    Attributes:
        episode: Latest message about the episode.
        latest: What the modules said in the latest tick.
        results: Outcomes so far.
        finished: Done when all episodes have ended.
        ticks: Ticks that the graph has answered.
    """

    def __init__(self, episodes: int, **options: Any) -> None:
        """Watch until so many episodes have ended."""
        super().__init__("monitor", **options)
        self.episode: Episode | None = None
        self.latest: Watched | None = None
        self.results: list[EpisodeResult] = []
        self.finished = Future()
        self.ticks = 0
        self._episodes = episodes
        self._started = self._ended = 0.0
        self._join = Synchroniser([t.name for t in _WATCHED], depth=64)
        self._log = EpisodeLog(0)
        self._sequence = 0
        self._joined = -1
        self._end: Episode | None = None
        qos = live_qos(depth=1024)
        self.create_subscription(Episode, topics.EPISODE.name, self._on_episode, qos, raw=True)
        for topic in _WATCHED:
            self.create_subscription(topic.type, topic.name, partial(self._receive, topic.name), qos, raw=True)

    @property
    def stamp(self) -> int:
        """Simulated time of the latest message about the episode [ns]."""
        return 0 if self.episode is None else conversions.stamp_of(self.episode)

    @property
    def ticks_per_second(self) -> float:
        """Ticks answered by the graph per second of wall time."""
        seconds = self._ended - self._started
        return self.ticks / seconds if seconds > 0 else 0.0

    def _receive(self, name: str, message: bytes) -> None:
        stamp = raw_stamp(message)
        if stamp <= self._joined:
            return
        joined = self._join.add(name, stamp, message)
        if joined is not None:
            self._joined = stamp
            self._on_tick(Watched(joined))

    def _on_episode(self, raw: bytes) -> None:
        message = read(raw, Episode)
        if self._end is not None:
            self._finish()
        self._started = self._started or time.perf_counter()
        if self.episode is None or message.episode != self.episode.episode:
            self._log, self._sequence = EpisodeLog(message.seed), 0
        elif message.header.stamp == self.episode.header.stamp:
            return
        self.episode = message
        if message.terminated or message.truncated:
            self._end = message
            self._finish_when_joined()

    def _on_tick(self, tick: Watched) -> None:
        self.latest = tick
        self.ticks += 1
        said = tick.instruction
        if said.sequence != self._sequence:
            self._sequence = said.sequence
            self._log.decided(tick.truth, tick.estimate, said.direction, tick.termination.timed_out)
        self._finish_when_joined()

    def _finish_when_joined(self) -> None:
        """End the episode when the tick before its last has been noted."""
        if self._end is not None and self._joined >= conversions.stamp_of(self._end) - topics.TICK:
            self._finish()

    def _finish(self) -> None:
        end, self._end = self._end, None
        assert end is not None
        self._ended = time.perf_counter()
        self.results.append(self._log.result(solved=end.solved, steps=end.step, episode_return=end.episode_return))
        if len(self.results) == self._episodes:
            self.finished.set_result(None)
