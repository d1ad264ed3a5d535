"""The node that watches the graph: outcomes of episodes, and the tick that a view shows."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from typing import Any, Final, NamedTuple, Unpack

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future

from bringup.failure import EpisodeLog
from bringup.results import EpisodeResult
from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_core.plugins import AGENT
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.conversions import EpisodeTruthReading
from mujoban_msgs_py.listening import PublisherWatch, Received, TruthWatch, listen, refuse_run
from mujoban_msgs_py.run_identifier import ANY
from mujoban_msgs_py.runtime.descriptors import NodeOptions
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_msgs_py.synchroniser import Synchroniser
from mujoban_sokoban.episodes import Episodes

_AHEAD: Final = 100 * topics.TICK
"""Simulated time [ns] by which modules may be heard before the simulator; what is further ahead is a stranger's."""
_PATIENCE: Final = 5.0
"""Seconds without a word of the simulator after which the last end that was heard counts as it is."""
_REFUTED: Final = 10
"""Ticks that the graph answers after an end was denied, until that is forgotten; fewer may still be on their way."""
_WATCHED = (topics.INSTRUCTION, topics.TERMINATION, topics.ABSTRACT_STATE, topics.TRUE_ABSTRACT_STATE)
"""What tells what the modules decided."""
_WATCHED_ALONE = (topics.TORQUE, topics.TRUE_ABSTRACT_STATE)
"""What there is to watch of an agent without modules."""


class Watched(NamedTuple):
    """What the modules said in the latest tick."""

    values: dict[str, Any]
    """Topic name -> what the topic's reader made of the message."""

    @property
    def alone(self) -> bool:
        """Whether an agent plays, which decides nothing that could be looked at."""
        return topics.INSTRUCTION.name not in self.values

    @property
    def torque(self) -> NDArray[np.float32]:
        """a_tau of an agent that plays alone, [U]."""
        return self.values[topics.TORQUE.name]

    @property
    def instruction(self) -> conversions.InstructionReading:
        """A."""
        return self.values[topics.INSTRUCTION.name]

    @property
    def termination(self) -> conversions.TerminationReading:
        """Beta."""
        return self.values[topics.TERMINATION.name]

    @property
    def estimate(self) -> NDArray[np.float32]:
        """Estimated abstract state, [N, N, 4]."""
        return self.values[topics.ABSTRACT_STATE.name]

    @property
    def truth(self) -> NDArray[np.float32]:
        """True abstract state, [N, N, 4]."""
        return self.values[topics.TRUE_ABSTRACT_STATE.name]


class MonitorNode(GraphNode):
    """Turns the graph's messages into outcomes of episodes, as `bringup.rollout` does with its ticks.

    Attributes:
        episode: Latest message about the episode.
        latest: What the modules said in the latest tick.
        results: Outcomes so far.
        finished: Done when all episodes have ended.
        ticks: Ticks that the graph has answered.
        counts: Events that a user should know of.
        run: Identifier of the run that is watched.
    """

    def __init__(
        self, episodes: Episodes, *, alone: bool = False, run: int = ANY, **options: Unpack[NodeOptions]
    ) -> None:
        """Watch until as many episodes have ended; what another run says of its own is no result of this one.

        Args:
            episodes: Which are played.
            alone: Whether an agent plays alone, without modules.
            run: Identifier of the run, if it is known.
            **options: Of the node.
        """
        super().__init__("monitor", **options)
        self.run = run
        self.episode: EpisodeTruthReading | None = None
        self.stamp = 0
        """Simulated time of the latest message about the episode [ns]."""
        self.latest: Watched | None = None
        self.results: list[EpisodeResult] = []
        self.finished = Future()
        self.ticks = 0
        self.counts: Counter[str] = Counter()
        self._episodes = episodes
        self._started = self._ended = 0.0
        watched = _WATCHED_ALONE if alone else _WATCHED
        self._join = Synchroniser([t.name for t in watched], depth=64)
        self._log = EpisodeLog(0)
        self._sequence = 0
        self._first = 0
        """Stamp of the first tick of the episode that was heard [ns]."""
        self._joined = -1
        self._end: Received | None = None
        self._doubted: Received | None = None
        self._doubted_at = 0
        self._heard = time.monotonic()
        self.create_timer(_PATIENCE / 10, self._end_in_silence)
        qos = live_qos(depth=1024)
        listen(self, topics.TRUE_EPISODE, self._on_episode, qos=qos)
        for topic in watched:
            steady = topic == topics.TRUE_ABSTRACT_STATE
            listen(self, topic, partial(self._receive, topic.name), qos=qos, steady=steady)
        self._acknowledge = self.create_output(topics.MONITORED)
        self.truth_watch = TruthWatch(self)
        self.watch = PublisherWatch(self, topics.PUBLISHERS | ({topics.TORQUE.name: AGENT} if alone else {}))

    @property
    def ticks_per_second(self) -> float:
        """Ticks answered by the graph per second of wall time."""
        seconds = self._ended - self._started
        return self.ticks / seconds if seconds > 0 else 0.0

    def _receive(self, name: str, message: Received) -> None:
        if not self._joined < message.stamp <= self.stamp + _AHEAD:
            return
        joined = self._join.add(name, message.stamp, message.content)
        if joined is not None:
            self._joined = message.stamp
            self._on_tick(Watched(joined))

    def _on_episode(self, received: Received) -> None:
        said: EpisodeTruthReading = received.content
        if said.seed not in self._episodes.seeds or said.difficulty != self._episodes.difficulty:
            refuse_run(self, f"it plays seed {said.seed} at difficulty {said.difficulty}")
            return
        self._heard = time.monotonic()
        if self._end is not None and said.episode == self._end.content.episode:
            # The episode goes on, so that its end was not the simulator's word; or a stranger says that it does.
            if received.stamp != self._end.stamp:
                self._doubted, self._end, self._doubted_at = self._end, None, self.ticks
                self.counts["contradictory episodes"] += 1
        elif self._end is not None or (self._doubted is not None and said.episode != self._doubted.content.episode):
            self._finish()
        self._started = self._started or time.perf_counter()
        if self.episode is None or said.episode != self.episode.episode:
            self._log, self._sequence = EpisodeLog(said.seed), 0
            self._first = received.stamp
        elif received.stamp == self.stamp:
            self._confirm()  # the simulator offers the tick again
            return
        self.episode, self.stamp = said, received.stamp
        if self._joined > self.stamp + _AHEAD:  # what was joined was of no tick of the simulator's
            self._joined = -1
        if said.terminated or said.truncated:
            self._end = received
            self._finish_when_joined()
        self._confirm()

    def _on_tick(self, tick: Watched) -> None:
        self.latest = tick
        self.ticks += 1
        if self.ticks - self._doubted_at > _REFUTED:
            self._doubted = None  # the episode does go on
        # In real time the last answers of an episode may come after the next one has begun.
        said = None if tick.alone or self._joined < self._first else tick.instruction
        if said is not None and said.sequence != self._sequence:
            self._sequence = said.sequence
            self._log.decided(tick.truth, tick.estimate, said.direction, tick.termination.timed_out)
        self._finish_when_joined()
        self._confirm()

    def _confirm(self) -> None:
        """Say that the latest tick was heard, once it was; in one process nobody asks."""
        if self.episode is None or not self._acknowledge.subscriptions:
            return
        if self._joined >= self.stamp or self.episode.terminated or self.episode.truncated:
            self._acknowledge.publish(conversions.header(self.stamp))

    def _finish_when_joined(self) -> None:
        """End the episode when the tick before its last has been noted."""
        if self._end is not None and self._joined >= self._end.stamp - topics.TICK:
            self._finish()

    def _end_in_silence(self) -> None:
        """End an episode of which nothing more is heard.

        In real time the tick before its last may stay without an answer, and a stranger may have denied its end.
        """
        ended = self._end is not None or self._doubted is not None
        if ended and time.monotonic() - self._heard > _PATIENCE:
            self._finish()

    def _finish(self) -> None:
        end = self._end or self._doubted
        self._end = self._doubted = None
        assert end is not None
        self._ended = time.perf_counter()
        # In real time, or of a stranger, an end may be heard before any tick.
        last = np.zeros((GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32) if self.latest is None else self.latest.truth
        truth: EpisodeTruthReading = end.content
        self.results.append(
            self._log.result(solved=truth.solved, steps=truth.step, episode_return=truth.episode_return, last=last)
        )
        if len(self.results) == len(self._episodes):
            self.finished.set_result(None)
