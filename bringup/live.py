"""The node that streams the graph to Rerun (`python -m bringup.live`), for a viewer in the browser or a file.

It only subscribes, so it works beside a stack in another process and on a bag that is played back. `rerun-sdk` is an
optional dependency: `pip install 'mujoban[view]'`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mujoban_msgs.msg import AbstractState, Episode, Instruction, Termination
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.tick_node import live_qos, run_node
from mujoban_sim.grid import CHANNELS
from mujoban_sim.grid import Instruction as Direction

APPLICATION: Final = "mujoban"
_PERIOD: Final = 2
"""Ticks between two pictures: 10 Hz is enough for the eye."""
_COLOURS: Final = np.array([[150, 140, 140], [200, 30, 30], [40, 90, 230], [230, 200, 30]], np.float32)
"""RGB of the layers wall, target, agent, box."""


class LiveNode(Node):
    """Logs cameras, grids, instruction, beta, torques, reward and the time that each module takes.

    Parameters:
        save: Recording (.rrd) to write; empty streams to a viewer.
        grpc_port: Port on which the stream is served.
        web_port: Port on which the viewer's page is served.
    """

    def __init__(self, **options: Any) -> None:
        """Open the stream and start listening."""
        super().__init__("live", **options)
        fixed = ParameterDescriptor(read_only=True)
        save = self.declare_parameter("save", "", fixed).value
        grpc_port = self.declare_parameter("grpc_port", 9876, fixed).value
        web_port = self.declare_parameter("web_port", 9090, fixed).value
        self._stream = rr.RecordingStream(APPLICATION)
        if save:
            self._stream.save(save, default_blueprint=blueprint())
        else:
            address = self._stream.serve_grpc(grpc_port=grpc_port, default_blueprint=blueprint())
            rr.serve_web_viewer(web_port=web_port, open_browser=False, connect_to=address)
            self.get_logger().info(f"live view on http://localhost:{web_port}/?url={address.replace('+', '%2B')}")
        self._offered: dict[int, float] = {}
        handlers: dict[topics.Topic, Callable[[Any], None]] = {
            topics.EPISODE: self._on_episode,
            topics.CAMERA: lambda m: self._on_image("camera/first_person", m),
            topics.TOP_CAMERA: lambda m: self._on_image("camera/top_down", m),
            topics.ABSTRACT_STATE: lambda m: self._on_grid("grid/estimate", m),
            topics.TRUE_ABSTRACT_STATE: lambda m: self._on_grid("grid/ground_truth", m),
            topics.TERMINATION: self._on_termination,
            topics.INSTRUCTION: self._on_instruction,
            topics.TORQUE: self._on_torque,
        }
        self._sequence = -1
        for topic, handler in handlers.items():
            self.create_subscription(topic.type, topic.name, handler, live_qos())

    def destroy_node(self) -> None:
        """Finish the stream; a recording is whole only then."""
        self._stream.flush()
        self._stream.disconnect()
        super().destroy_node()

    def _at(self, message: Any) -> int:
        stamp = conversions.stamp_of(message)
        self._stream.set_time("simulated_time", duration=stamp / 1e9)
        return stamp

    def _log_delay(self, module: str, stamp: int) -> None:
        """Log the wall time from the offer of a tick to a module's answer."""
        offered = self._offered.get(stamp)
        if offered is not None:
            self._stream.log(f"milliseconds/{module}", rr.Scalars(1000 * (time.perf_counter() - offered)))

    def _on_episode(self, message: Episode) -> None:
        stamp = self._at(message)
        self._offered = {stamp: time.perf_counter()}
        self._stream.log("reward/step", rr.Scalars(message.reward))
        self._stream.log("reward/return", rr.Scalars(message.episode_return))

    def _on_image(self, entity: str, message: Image) -> None:
        if self._at(message) // topics.TICK % _PERIOD == 0:
            self._stream.log(entity, rr.Image(conversions.frame_from_msg(message, None)))

    def _on_grid(self, entity: str, message: AbstractState) -> None:
        stamp = self._at(message)
        if entity.endswith("estimate"):
            self._log_delay("estimator", stamp)
        if stamp // topics.TICK % _PERIOD:
            return
        state = conversions.abstract_state_from_msg(message)
        self._stream.log(entity, rr.Image(picture(state)))
        for channel, name in enumerate(CHANNELS):
            self._stream.log(f"{entity}/{name}", rr.DepthImage(state[..., channel], meter=1.0))

    def _on_termination(self, message: Termination) -> None:
        self._log_delay("termination", self._at(message))
        self._stream.log("beta/probability", rr.Scalars(message.probability))
        self._stream.log("beta/terminated", rr.Scalars(float(message.terminated)))

    def _on_instruction(self, message: Instruction) -> None:
        self._log_delay("planner", self._at(message))
        self._stream.log("instruction", rr.Scalars(message.direction))
        if message.sequence != self._sequence:
            self._sequence = message.sequence
            name = Direction(message.direction).name.lower()
            self._stream.log("instructions", rr.TextLog(f"{message.sequence}: {name}"))

    def _on_torque(self, message: JointState) -> None:
        self._log_delay("controller", self._at(message))
        self._stream.log("torque", rr.Scalars(np.array(message.effort)))


def picture(state: np.ndarray) -> np.ndarray:
    """Return an abstract state, probabilities [N, N, 4], as colours, uint8 [N, N, 3]."""
    weight = state[..., None]
    canvas = np.full((*state.shape[:2], 3), 30.0, np.float32)
    for channel in range(len(CHANNELS)):
        canvas = (1 - weight[:, :, channel]) * canvas + weight[:, :, channel] * _COLOURS[channel]
    return canvas.astype(np.uint8)


def blueprint() -> rrb.Blueprint:
    """Return the arrangement of the view."""
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="camera/first_person", name="first person"),
                rrb.Spatial2DView(origin="camera/top_down", name="top down"),
                rrb.Spatial2DView(origin="grid/estimate", contents=["grid/estimate"], name="estimate"),
                rrb.Spatial2DView(origin="grid/ground_truth", contents=["grid/ground_truth"], name="truth"),
            ),
            rrb.Horizontal(
                rrb.TimeSeriesView(origin="beta", name="beta"),
                rrb.TimeSeriesView(origin="torque", name="torque"),
                rrb.TimeSeriesView(origin="reward", name="reward"),
                rrb.TimeSeriesView(origin="milliseconds", name="milliseconds"),
                rrb.TextLogView(origin="instructions", name="instructions"),
            ),
        )
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(LiveNode, args)


if __name__ == "__main__":
    sys.exit(main())
