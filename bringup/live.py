"""The node that streams the graph to Rerun (`python -m bringup.live`), for a viewer in the browser or a file.

It only subscribes, so it works beside a stack in another process and on a bag that is played back. It must not hold up
the graph either: it runs at low priority, drops what it has no time for, and draws a few pictures a second.
`rerun-sdk` is an optional dependency: `pip install 'mujoban[view]'`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, Unpack

import numpy as np
import rerun as rr
from diagnostic_msgs.msg import DiagnosticArray
from mujoban_msgs.msg import AbstractState, EpisodeTruth, Instruction, Termination
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, JointState

from bringup.live_layout import CELL, ESTIMATE, TRUTH, Shown, arrow, blueprint, describe, text, told, torque_curves
from bringup.live_server import LiveServer
from bringup.options import LOOPBACK
from bringup.overlay import grid_picture
from bringup.players import players
from mujoban_core.grid import AGENT, CHANNELS
from mujoban_core.grid import Instruction as Direction
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.decoders import checked
from mujoban_msgs_py.listening import belongs, reject
from mujoban_msgs_py.raw import raw_stamp, read
from mujoban_msgs_py.runtime import diagnostics
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, declare_run, described
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos, run_node
from mujoban_msgs_py.topics import TICK, Topic

APPLICATION: Final = "mujoban"
NICENESS: Final = 10
"""Of the node's process: the graph comes first."""
_PERIOD: Final = 0.1
"""Seconds between two pictures in the browser: 10 Hz is enough for the eye."""
_TICKS: Final = 4
"""Ticks between two pictures."""
_QUEUE: Final = 16
"""Ticks that wait for the stream; what comes on top is dropped."""
_EDGE: Final = 256
"""Pixels along the edge of a picture at most."""
_MODULES: Final = {topic: topics.PUBLISHERS[topic.name] for topic in topics.MODULE_TOPICS}


class _Received(NamedTuple):
    """When a message was received."""

    stamp: int
    """Of the tick [ns of simulated time]."""
    at: float
    """Wall time [s]."""


class LiveNode(GraphNode):
    """Logs cameras, grids, instruction, beta, torques, reward and the time that each module takes.

    A module's time runs from the message of the same tick that came before its own: where all nodes share one process
    it is the module's own; the simulator's runs from one tick's torque to the last of the next tick's observation. Both
    are wall time as this node sees it: an EventsExecutor has no time of publication.

    Parameters:
        save: Recording (.rrd) to write; empty streams to a viewer.
        address: IP address on which stream and page are served; 0.0.0.0 for every interface.
        grpc_port: Port on which the stream is served, or the next free one.
        web_port: Port on which the viewer's page is served, or the next free one.
        run: Identifier of the run that is shown; -1 for any.
    """

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Open the stream and start listening."""
        super().__init__("live", **options)
        self.run = declare_run(self)
        self.counts: Counter[str] = Counter()
        save = declare(self, "save", "", described("recording (.rrd) to write; empty: a page is served", fixed=True))
        address = declare(self, "address", LOOPBACK, described("IP address of the page; 0.0.0.0: all", fixed=True))
        port = described("port, or the next free one", fixed=True, low=1, high=2**16 - 1)
        grpc_port, web_port = declare(self, "grpc_port", 9876, port), declare(self, "web_port", 9090, port)
        self._stream = rr.RecordingStream(APPLICATION)
        self._period = 0.0 if save else _PERIOD
        self._server: LiveServer | None = None
        if save:
            self._stream.save(save, default_blueprint=blueprint())
        else:
            self._server = LiveServer(address, grpc_port, web_port)
            self._stream.connect_grpc(self._server.stream, default_blueprint=blueprint())
            self.get_logger().info(f"live view on {self._server.page}")
        describe(self._stream)
        self._pictured, self._drawn = -1, 0.0
        self._latest = _Received(-1, 0.0)
        self._torque = _Received(-1, 0.0)
        self._shown = Shown(None, None, {})
        self._log_told()
        self._agent = (0.0, 0.0)
        self._has_named_torques = False
        handlers: dict[Topic, Callable[[int, Any], None]] = {
            topics.TRUE_EPISODE: self._on_episode,
            topics.CAMERA: partial(self._on_image, "camera/first_person"),
            topics.TRUE_ABSTRACT_STATE: partial(self._on_grid, TRUTH),
            topics.TOP_CAMERA: partial(self._on_image, "camera/top_down"),
            topics.ABSTRACT_STATE: partial(self._on_grid, ESTIMATE),
            topics.TERMINATION: self._on_termination,
            topics.INSTRUCTION: self._on_instruction,
            topics.TORQUE: self._on_torque,
        }
        self.create_subscription(DiagnosticArray, diagnostics.TOPIC, self._on_diagnostics, 10)
        qos = live_qos() if save else QoSProfile(depth=_QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
        for topic, handle in handlers.items():
            self.create_subscription(topic.type, topic.name, self._receiver(topic, handle), qos, raw=True)

    def destroy_node(self) -> None:
        """Finish the stream; a recording is whole only then."""
        if self._server is None:
            self._stream.flush()
        self._stream.disconnect()
        if self._server is not None:
            self._server.close()
        super().destroy_node()

    def _receiver(self, topic: Topic, handle: Callable[[int, Any], None]) -> Callable[[bytes], None]:
        is_picture, check = topic.type in (Image, AbstractState), checked(topic)

        def receive(message: bytes) -> None:
            at = time.perf_counter()
            try:
                stamp = raw_stamp(message)
                is_shown = not is_picture or self._is_drawn(stamp)
                content = read(message, topic.type, check) if is_shown else None
            except ValueError as error:
                reject(self, topic.name, error)
                return
            if not belongs(self, topic.name, stamp):
                return
            self._stream.set_time("simulated_time", duration=stamp / 1e9)
            self._log_time(topic, _Received(stamp, at))
            if is_shown:
                handle(stamp, content)

        return receive

    def _is_drawn(self, stamp: int) -> bool:
        """Tell whether the pictures of a tick are shown: those of every `_TICKS`, and not more often than `_PERIOD`."""
        now = time.monotonic()
        if stamp != self._pictured and stamp // TICK % _TICKS == 0 and now - self._drawn >= self._period:
            self._pictured, self._drawn = stamp, now
        return stamp == self._pictured

    def _log_time(self, topic: Topic, received: _Received) -> None:
        """Log how long after the message before it an answer came."""
        before, self._latest = self._latest, received
        module = _MODULES.get(topic)
        if module is None or received.stamp != before.stamp:
            return
        self._log_milliseconds(module, before, received)
        if module == "estimator" and received.stamp == self._torque.stamp + TICK:
            self._log_milliseconds("simulator", self._torque, before)
        if module == "controller":
            self._torque = received

    def _log_milliseconds(self, what: str, start: _Received, end: _Received) -> None:
        self._stream.log(f"milliseconds/{what}", rr.Scalars(1000 * (end.at - start.at)))

    def _on_episode(self, stamp: int, message: EpisodeTruth) -> None:
        self._shown = self._shown._replace(episode=message)
        self._stream.log("reward/step", rr.Scalars(message.reward))
        self._stream.log("reward/return", rr.Scalars(message.episode_return))
        if message.terminated or message.truncated:  # no instruction follows, which would show it
            self._log_text()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Note which module each node runs."""
        modules = players(message, self._shown.modules)
        if modules != self._shown.modules:
            self._shown = self._shown._replace(modules=modules)
            self._log_told()

    def _log_told(self) -> None:
        """Log who is told the ground truth, for every moment of a recording: also for those before it was heard."""
        shown = rr.TextDocument(told(self._shown.modules), media_type=rr.MediaType.MARKDOWN)
        self._stream.log("told", shown, static=True)

    def _log_text(self) -> None:
        self._stream.log("now", rr.TextDocument(text(self._shown), media_type=rr.MediaType.MARKDOWN))

    def _on_image(self, entity: str, stamp: int, message: Image) -> None:
        frame = conversions.frame_from_msg(message, None)
        stride = -(-frame.shape[0] // _EDGE)
        self._stream.log(entity, rr.Image(frame[::stride, ::stride]))

    def _on_grid(self, entity: str, stamp: int, message: AbstractState) -> None:
        state = conversions.abstract_state_from_msg(message)
        self._stream.log(entity, rr.Image(grid_picture(state, CELL)))
        for channel, name in enumerate(CHANNELS):
            self._stream.log(f"{entity}/{name}", rr.DepthImage(state[..., channel], meter=1.0))
        if entity == ESTIMATE:
            row, column = np.unravel_index(int(np.argmax(state[..., AGENT])), state.shape[:2])
            self._agent = (CELL * (float(column) + 0.5), CELL * (float(row) + 0.5))

    def _on_termination(self, stamp: int, message: Termination) -> None:
        self._stream.log("beta/probability", rr.Scalars(message.probability))
        if message.terminated:
            self._stream.log("beta/terminated", rr.Scalars(1.0))

    def _on_instruction(self, stamp: int, message: Instruction) -> None:
        before = self._shown.instruction
        self._shown = self._shown._replace(instruction=message)
        self._stream.log("instruction", rr.Scalars(message.direction))
        if before is None or message.sequence != before.sequence:
            name = Direction(message.direction).name.lower()
            self._stream.log("instructions", rr.TextLog(f"{message.sequence}: {name}"))
        elif stamp != self._pictured:
            return
        self._stream.log(f"{ESTIMATE}/instruction", arrow(self._agent, message.direction))
        self._log_text()

    def _on_torque(self, stamp: int, message: JointState) -> None:
        if not self._has_named_torques:
            self._has_named_torques = True
            self._stream.log("torque", torque_curves([*message.name], len(message.effort)), static=True)
        self._stream.log("torque", rr.Scalars(np.array(message.effort)))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    os.nice(NICENESS)
    return run_node(LiveNode, args)


if __name__ == "__main__":
    leave(main())
