"""Write the ticks of a batched rollout as bags, one bag for each row of the world.

The bags are those that `run_stack.py --record` writes: the same messages with the same stamps, and simulated time as
log time. Only the view from above is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np
from rclpy.serialization import serialize_message

from bringup.rollout import Tick
from mujoban_core.bodies import Body
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagWriter
from mujoban_msgs_py.bags.writer import FLUSH_AFTER
from mujoban_msgs_py.topics import TICK, Message, Topic
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.tick_messages import EpisodeProgress, SimulatorTick, TickComposer, TickLabel
from mujoban_sokoban.episodes import EpisodeSpec

TOPICS: Final = tuple(t for t in (*topics.SIMULATOR_TOPICS, *topics.MODULE_TOPICS) if t is not topics.TOP_CAMERA)
"""What is recorded by default."""
_CLOSING: Final = 8
"""Bags that are closed at once."""


@dataclass
class _Row:
    """What the messages of a row's next tick say about the past."""

    writer: BagWriter
    composer: TickComposer
    stamp: int = 0
    episode: int = 0
    sequence: int = 0
    """Of the instruction in force before the tick; 0 for none."""
    reward: float = 0.0
    episode_return: float = 0.0


class Recorder:
    """Writes ticks to bags `<path>/<prefix>row<r>`; use it as a context manager."""

    def __init__(
        self,
        path: Path,
        body: Body,
        episodes: Sequence[EpisodeSpec],
        difficulties: Sequence[int],
        *,
        prefix: str = "",
        world: str = DEFAULT_WORLD,
        privileged: str = "",
        episodes_per_file: int | None = 16,
    ) -> None:
        """Record into a folder.

        Args:
            path: Folder of the bags.
            body: The robot's body.
            episodes: Those that the ticks number.
            difficulties: Difficulty of each, 0 for levels from a file.
            prefix: Start of the bags' names, to tell recorders that share a folder apart.
            world: The physical world, which the bags name.
            privileged: Roles that are told the ground truth, which the bags name, or `none`; empty: they do not.
            episodes_per_file: Episodes in one file of a bag; None: all.
        """
        self._path, self._prefix, self._episodes_per_file = path, prefix, episodes_per_file
        self._episodes, self._difficulties = episodes, difficulties
        self._body = body
        self._about = {"body": body.name, "world": world} | ({"privileged": privileged} if privileged else {})
        self._rows: dict[int, _Row] = {}
        self.ticks = 0
        """Ticks written."""

    def __enter__(self) -> Self:
        """Return the recorder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bags."""
        self.close()

    def close(self) -> None:
        """Close the bags, several at once: each waits for the disk."""
        with ThreadPoolExecutor(_CLOSING) as closing:  # all of them, also where one fails
            closed = [closing.submit(row.writer.close) for row in self._rows.values()]
        for bag in closed:
            bag.result()

    def write(self, tick: Tick, check: Callable[[], None] = lambda: None) -> None:
        """Write one tick of every row in which an episode runs.

        Args:
            tick: The tick.
            check: Called before each row; all bags are whole also where it raises.
        """
        for m, number in enumerate(tick.rows.tolist()):
            check()
            if number not in self._rows:
                path = self._path / f"{self._prefix}row{number:03d}"
                # Physics are the same to the last bit where there is room for as many boxes.
                room = str(tick.truth.box_position.shape[1])
                writer = BagWriter(
                    path, TOPICS, episodes_per_file=self._episodes_per_file, flush_after=FLUSH_AFTER,
                    about={**self._about, "max_boxes": room},
                )  # fmt: skip
                self._rows[number] = _Row(writer, TickComposer(self._body))
            self._write_row(self._rows[number], tick, m)
            self.ticks += 1

    def _write_row(self, row: _Row, tick: Tick, m: int) -> None:
        if tick.step[m] == 0:
            row.episode += 1
            row.sequence, row.reward, row.episode_return = 0, 0.0, 0.0
        row.stamp += TICK
        seen = SimulatorTick(self._label(row, tick, m), self._progress(row, tick, m), tick.observation, tick.truth, m)
        self._observed(row, seen)
        self._put(row, _decided(row, tick, m, self._body))
        row.sequence = int(tick.decision.sequence[m])
        row.reward, row.episode_return = float(tick.reward[m]), float(tick.episode_return[m])
        if tick.solved[m] or tick.truncated[m]:
            self._end(row, tick, m)

    def _end(self, row: _Row, tick: Tick, m: int) -> None:
        """Write how the episode ended, which needs no answer."""
        if tick.ending is None:
            raise ValueError("an episode ends in a tick without an ending: expected what the robot perceives then")
        row.stamp += TICK
        ended = np.flatnonzero(tick.solved | tick.truncated)
        progress = self._progress(row, tick, m)._replace(
            step=int(tick.step[m]) + 1, solved=bool(tick.solved[m]), truncated=bool(tick.truncated[m])
        )
        index = int(np.searchsorted(ended, m))
        self._observed(row, SimulatorTick(self._label(row, tick, m), progress, *tick.ending, index))
        row.writer.end_episode()

    def _put(self, row: _Row, messages: Mapping[Topic, Message]) -> None:
        for topic, message in messages.items():
            row.writer.write(topic.name, row.stamp, serialize_message(message))

    def _label(self, row: _Row, tick: Tick, m: int) -> TickLabel:
        return TickLabel(row.stamp, row.episode, self._difficulties[int(tick.episode[m])], row.sequence)

    def _progress(self, row: _Row, tick: Tick, m: int) -> EpisodeProgress:
        spec = self._episodes[int(tick.episode[m])]
        return EpisodeProgress(spec, int(tick.step[m]), row.reward, row.episode_return, solved=False, truncated=False)

    def _observed(self, row: _Row, tick: SimulatorTick) -> None:
        """Write what the simulator says in a tick."""
        self._put(row, {topic: row.composer.compose(topic, tick) for topic in row.composer.topics})


def _decided(row: _Row, tick: Tick, m: int, body: Body) -> dict[Topic, Message]:
    """Return what the four modules say in a tick."""
    said = tick.decision
    beta = said.termination
    header = conversions.header(row.stamp, topics.MAP_FRAME)
    termination = conversions.termination_value(
        row.sequence, beta.probability[m], beta.terminated[m], beta.timed_out[m]
    )
    instruction = conversions.instruction_value(said.sequence[m], said.instruction[m])
    return {
        topics.ABSTRACT_STATE: conversions.abstract_state_to_msg(header, said.abstract_state[m]),
        topics.TERMINATION: conversions.termination_to_msg(header, termination),
        topics.INSTRUCTION: conversions.instruction_to_msg(header, instruction),
        topics.TORQUE: conversions.torque_to_msg(header, said.torque[m], body.actuated),
    }
