"""The node that records the graph into a bag (`python -m bringup.graph_recorder --ros-args -p path:=DIR`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Unpack

from mujoban_core.grid import GRID_SIZE
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagWriter
from mujoban_msgs_py.bags.writer import FLUSH_AFTER
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.runtime.descriptors import RclpyOptions, declare, declare_run, described
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos, run_node
from mujoban_msgs_py.topics import GRAPH_TOPICS, MODULE_TOPICS, RECORDED, SIMULATOR_TOPICS

HELD_TICKS = 40
"""Unfinished ticks kept in real time, where answers may be late: 2 s."""
QUEUE_DEPTH = 1024
JUMP = 10
"""Offers in a row of ticks before the latest in the bag by which time has jumped back; fewer may be a stranger's."""
MOST_EPISODES = 2**31 - 1
"""In one file."""


class RecorderNode(GraphNode):
    """Writes every tick of the graph, its topics in a fixed order and with simulated time as log time.

    A tick is written when all its topics have arrived; then `/recorded` says so. A simulator that awaits this in
    lockstep loses nothing. In real time a tick is written as it is when it has become too old, and what it lacks is
    counted. Repeated messages are written once. What it records goes through the middleware: a bag holds what is sent.
    Where simulated time jumps back, as with a second simulator, the next file of the bag begins.

    Parameters:
        path: Folder of the bag, which must not exist yet.
        episodes_per_file: Episodes after which the next file of the bag begins.
        instructed: Whether four modules play; if not, an agent, of which there are torques alone.
        body, world: Of the robot and of the physics, which the bag names; empty: it does not.
        privileged: Roles that are told the ground truth, which the bag names, or `none`; empty: it does not.
        run: Identifier of the run that is recorded; -1 for any.

    Attributes:
        counts: Messages that were never received, or belong to no tick of the simulator, by topic.
        written: Stamp of the latest tick in the bag [ns].
    """

    def __init__(self, **options: Unpack[RclpyOptions]) -> None:
        """Make the bag and start listening.

        Raises:
            BagError: If the folder exists already.
        """
        super().__init__("recorder", **options)
        path = declare(self, "path", "bag", described("folder of the bag, which must not exist yet", fixed=True))
        count = described("episodes after which the next file of the bag begins", fixed=True, low=1, high=MOST_EPISODES)
        episodes_per_file = declare(self, "episodes_per_file", 32, count)
        whose = described("whether modules give instructions; an agent alone does not", fixed=True)
        self._answers = MODULE_TOPICS if declare(self, "instructed", True, whose) else (topics.TORQUE,)
        room = "boxes for which the world has room, for the bag to name; 0: not known"
        told = "roles that are told the ground truth, or none, for the bag to name"
        about = {
            "body": declare(self, "body", "", described("the robot's body, for the bag to name", fixed=True)),
            "world": declare(self, "world", "", described("the physical world, for the bag to name", fixed=True)),
            "privileged": declare(self, "privileged", "", described(told, fixed=True)),
            "max_boxes": declare(self, "max_boxes", 0, described(room, fixed=True, low=0, high=GRID_SIZE**2)),
        }
        self.run = declare_run(self)
        self.counts: Counter[str] = Counter()
        self._bag = BagWriter(
            Path(path), GRAPH_TOPICS.values(), episodes_per_file=episodes_per_file, flush_after=FLUSH_AFTER,
            about={name: str(value) for name, value in about.items() if value},
        )  # fmt: skip
        self._ticks: dict[int, dict[str, bytes]] = {}
        self._last_ticks: set[int] = set()
        self._behind: dict[int, dict[str, Received]] = {}
        """Messages of ticks before the latest in the bag, since the simulator offered a later one."""
        self._offers_behind = 0
        self.written = 0
        self._acknowledge = self.create_output(RECORDED)
        for topic in GRAPH_TOPICS.values():
            listen(self, topic, self._receiver(topic.name), qos=live_qos(QUEUE_DEPTH))

    def destroy_node(self) -> None:
        """Write what is left and finish the bag."""
        if not self._bag.closed:  # as it is where the disk was full
            self._flush(before=None)
            self._bag.close()
        super().destroy_node()

    def _receiver(self, name: str) -> Callable[[Received], None]:
        def receive(message: Received) -> None:
            if message.stamp > self.written:
                self._take(name, message)
            else:
                self._look_back(name, message)

        return receive

    def _take(self, name: str, message: Received) -> None:
        stamp = message.stamp
        self._ticks.setdefault(stamp, {}).setdefault(name, message.raw)
        if name == topics.EPISODE.name:
            self._forget_behind()
            if message.content.ended:
                self._last_ticks.add(stamp)
        self._write_if_complete(stamp)

    def _look_back(self, name: str, message: Received) -> None:
        """Note a message of a tick that is in the bag, or of another simulator whose time is behind."""
        stamp = message.stamp
        if name == topics.EPISODE.name and stamp == self.written:
            self._forget_behind()
            self._confirm(stamp)  # the simulator offers the tick again: it has missed our word
            return
        self._behind.setdefault(stamp, {}).setdefault(name, message)
        if len(self._behind) > HELD_TICKS:
            del self._behind[next(iter(self._behind))]
        if name == topics.EPISODE.name:
            self.counts["offers of earlier ticks"] += 1
            self._offers_behind += 1
            if self._offers_behind >= JUMP:
                self._start_anew()

    def _forget_behind(self) -> None:
        self._behind, self._offers_behind = {}, 0

    def _start_anew(self) -> None:
        """Go on in the next file of the bag with the ticks that were offered behind those in the bag."""
        self.get_logger().warning("simulated time jumped back: what follows goes into another file of the bag")
        offered = [tick for tick in self._behind.values() if topics.EPISODE.name in tick]
        self._forget_behind()
        self._flush(before=None)
        self._bag.split()
        self.written = 0
        for tick in offered:
            for name, message in tick.items():
                self._take(name, message)

    def _missing(self, stamp: int) -> list[str]:
        expected = SIMULATOR_TOPICS if stamp in self._last_ticks else (*SIMULATOR_TOPICS, *self._answers)
        return [topic.name for topic in expected if topic.name not in self._ticks[stamp]]

    def _write_if_complete(self, stamp: int) -> None:
        tick = self._ticks[stamp]
        if len(tick) >= len(SIMULATOR_TOPICS) and not self._missing(stamp):
            self._flush(before=stamp)
            self._write(stamp)
            self._confirm(stamp)
        elif len(self._ticks) > HELD_TICKS:
            observed = [s for s in self._ticks if self._is_observed(s)]
            # Those that the simulator has not offered are somebody else's: they are given up first, the oldest first.
            given_up = [s for s in self._ticks if not self._is_observed(s) and s != stamp]
            if given_up and len(observed) <= HELD_TICKS:
                self._forget(given_up[0])
            elif observed:
                self._write(min(observed))

    def _is_observed(self, stamp: int) -> bool:
        """Tell whether all that the simulator says of a tick is there; it says it in one go."""
        return all(topic.name in self._ticks[stamp] for topic in SIMULATOR_TOPICS)

    def _forget(self, stamp: int) -> None:
        self.counts.update(f"{name} of no tick" for name in self._ticks.pop(stamp))
        self._last_ticks.discard(stamp)

    def _flush(self, before: int | None) -> None:
        """Write unfinished ticks of the simulator up to a stamp, or all; forget what belongs to none."""
        for stamp in sorted(self._ticks):
            if before is None or stamp < before:
                if self._is_observed(stamp):
                    self._write(stamp)
                else:
                    self._forget(stamp)

    def _write(self, stamp: int) -> None:
        self.counts.update(f"{name} not recorded" for name in self._missing(stamp))
        tick = self._ticks.pop(stamp)
        for name in GRAPH_TOPICS:
            if name in tick:
                self._bag.write(name, stamp, tick[name])
        self.written = stamp
        if stamp in self._last_ticks:
            self._last_ticks.remove(stamp)
            self._bag.end_episode()

    def _confirm(self, stamp: int) -> None:
        self._acknowledge.publish(conversions.header(stamp))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(RecorderNode, args)


if __name__ == "__main__":
    leave(main())
