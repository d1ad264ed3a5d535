"""The node that shows the graph to standard tools, RViz and Foxglove among them (`python -m bringup.viz`).

It only subscribes to the graph, so it works beside a running stack and on a bag that is played back.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from array import array
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Final, Unpack

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Pose, Vector3
from mujoban_msgs.msg import AbstractState
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import ColorRGBA, Header, String
from visualization_msgs.msg import Marker, MarkerArray

from bringup.frames import camera_transforms, robot_description, robot_transform
from bringup.players import players
from mujoban_core.bodies import BALL, get_body
from mujoban_core.grid import CHANNELS, TARGET, WALL, cell_to_xy
from mujoban_core.plugins import TOLD, privileged_roles
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.decoders import checked
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.runtime import diagnostics
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, described
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos, run_node
from mujoban_sim.presets import DEFAULT_WORLD, get_world
from mujoban_sim.scene import BOX_HALF_EXTENT

PREFIX: Final = "/viz"
PERIOD: Final = 2
"""Ticks between two messages of a topic: 10 Hz is enough for the eye."""
_TARGET_HEIGHT: Final = 0.01
"""Of a target's tile, in cells."""
_ARROW: Final = (0.6, 0.15, 0.15)
"""Length, width and height of the robot's arrow, in cells."""
_COLOURS: Final = {
    "wall": (0.55, 0.5, 0.5, 1.0),
    "target": (0.8, 0.1, 0.1, 1.0),
    "box": (0.8, 0.75, 0.1, 1.0),
    "robot": (0.2, 0.4, 0.9, 1.0),
    "told": (0.94, 0.86, 0.24, 1.0),
}
_TEXT_HEIGHT: Final = 0.4
"""Of a letter, in cells: all four roles side by side are then hardly as wide as the grid."""


class VizNode(GraphNode):
    """Publishes the four layers of the estimate as occupancy grids and the true scene as markers.

    The scene names who is told the ground truth, above the grid.

    Topics: `/viz/estimate/<layer>` and `/viz/ground_truth/<layer>` (nav_msgs/OccupancyGrid, percent, frame `map`) for
    the layers wall, target, agent and box; `/viz/scene` (visualization_msgs/MarkerArray); `/robot_description` (URDF);
    and, where `tf2_msgs` is installed, `/tf` and `/tf_static` (see `bringup.frames`).

    Parameters:
        body, world: Of the robot and of the physics that are shown; they decide the sizes.
    """

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Start listening.

        Raises:
            ValueError: If there is no such body or world.
        """
        super().__init__("viz", **options)
        self._body = get_body(declare(self, "body", BALL.name, described("the robot's body", fixed=True)))
        world = declare(self, "world", DEFAULT_WORLD, described("the physical world", fixed=True))
        self._wall_height = get_world(world).drawn_wall_height
        self.counts: Counter[str] = Counter()
        self._pose: Pose | None = None
        self._posed = -1
        """Stamp of the latest pose [ns]."""
        self._boxes: list[Pose] = []
        self._modules: dict[str, str] = {}
        self._grids = {
            (source, name): self.create_publisher(OccupancyGrid, f"{PREFIX}/{source}/{name}", 1)
            for source in ("estimate", "ground_truth")
            for name in CHANNELS
        }
        self._describe()
        self._scene = self.create_publisher(MarkerArray, f"{PREFIX}/scene", 1)
        for topic, show in (
            (topics.ABSTRACT_STATE, self._on_estimate),
            (topics.TRUE_ABSTRACT_STATE, self._on_truth),
            (topics.POSE, self._on_pose),
            (topics.TRUE_BOXES, self._on_boxes),
        ):
            listen(self, topic, show, qos=live_qos(), decode=checked(topic))
        self.create_subscription(DiagnosticArray, diagnostics.TOPIC, self._on_diagnostics, 10)

    def _describe(self) -> None:
        """Publish what stays as it is, for those who join at any time."""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._description = self.create_publisher(String, "/robot_description", latched)
        self._description.publish(String(data=robot_description(self._body)))
        self._tf: Publisher | None = None
        if find_spec("tf2_msgs") is None:
            self.get_logger().info("tf2_msgs is not installed: /tf and /tf_static are left out")
            return
        from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]

        self._make_tf = TFMessage
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        self._tf_static = self.create_publisher(TFMessage, "/tf_static", latched)
        self._tf_static.publish(TFMessage(transforms=camera_transforms(self._body)))

    def _on_pose(self, message: Received) -> None:
        self._pose, before, self._posed = message.content.pose, self._posed, message.stamp
        # A tick that is offered again would have those who keep transforms complain of old data.
        if self._tf is not None and message.stamp != before:
            transform = robot_transform(message.content.header.stamp, message.content.pose)
            self._tf.publish(self._make_tf(transforms=[transform]))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._modules = players(message, self._modules)

    def _on_boxes(self, message: Received) -> None:
        self._boxes = list(message.content.poses)

    def _on_estimate(self, received: Received) -> None:
        message: AbstractState = received.content
        if self._is_due(message):
            self._publish_grids("estimate", message.header, conversions.abstract_state_from_msg(message))

    def _on_truth(self, received: Received) -> None:
        message: AbstractState = received.content
        if self._is_due(message):
            state = conversions.abstract_state_from_msg(message)
            self._publish_grids("ground_truth", message.header, state)
            self._scene.publish(MarkerArray(markers=self._markers(map_header(message.header), state)))

    def _is_due(self, message: AbstractState) -> bool:
        return conversions.stamp_of(message) // topics.TICK % PERIOD == 0

    def _publish_grids(self, source: str, header: Header, state: NDArray[np.float32]) -> None:
        for channel, name in enumerate(CHANNELS):
            self._grids[source, name].publish(occupancy_grid(header, state[..., channel], self._body.cell_size))

    def _markers(self, header: Header, state: NDArray[np.float32]) -> list[Marker]:
        markers, cell = [], self._body.cell_size
        for name, channel, cells in (("wall", WALL, self._wall_height), ("target", TARGET, _TARGET_HEIGHT)):
            height = cells * cell
            centres = cell_to_xy(np.argwhere(state[..., channel] > 0.5), cell)
            poses = [_pose(x, y, height / 2) for x, y in centres]
            markers.append(_cubes(header, name, poses, (cell, cell, height)))
        width, depth, half_height = (half * cell for half in BOX_HALF_EXTENT)
        boxes = [_pose(p.position.x, p.position.y, half_height) for p in self._boxes]
        markers.append(_cubes(header, "box", boxes, (2 * width, 2 * depth, 2 * half_height)))
        if self._pose is not None:
            length, breadth, thickness = (part * cell for part in _ARROW)
            markers.append(_marker(header, "robot", Marker.ARROW, (length, breadth, thickness), self._pose))
        return [*markers, self._told(header, state.shape[0])]

    def _told(self, header: Header, rows: int) -> Marker:
        """Return who is told the ground truth, north of a grid of so many rows; where nobody is, nothing is left."""
        cell, told = self._body.cell_size, privileged_roles(self._modules)
        place = _pose(0.0, (rows / 2 + 3 * _TEXT_HEIGHT) * cell, 0.0)
        marker = _marker(header, "told", Marker.TEXT_VIEW_FACING, (0.0, 0.0, _TEXT_HEIGHT * cell), place)
        marker.text = f"{TOLD}:\n{', '.join(told)}"
        if not told:
            marker.action = Marker.DELETE
        return marker


def map_header(header: Header) -> Header:
    """Return a header of the same stamp in the frame `map`."""
    return Header(stamp=header.stamp, frame_id=topics.MAP_FRAME)


def occupancy_grid(header: Header, layer: NDArray[np.float32], cell_size: float) -> OccupancyGrid:
    """Return one layer of an abstract state, [N, N], as percent per cell of `cell_size` metres.

    An occupancy grid begins in the south-west; row 0 of an abstract state is north.
    """
    rows, columns = layer.shape
    corner = Point(x=-columns * cell_size / 2, y=-rows * cell_size / 2)
    percent = np.rint(100 * layer[::-1]).astype(np.int8)
    info = MapMetaData(resolution=cell_size, width=columns, height=rows, origin=Pose(position=corner))
    info.map_load_time = header.stamp
    return OccupancyGrid(header=map_header(header), info=info, data=array("b", percent.tobytes()))


def _cubes(header: Header, name: str, poses: Sequence[Pose], size: tuple[float, float, float]) -> Marker:
    marker = _marker(header, name, Marker.CUBE_LIST, size, Pose())
    marker.points = [pose.position for pose in poses]
    if not poses:
        marker.action = Marker.DELETE
    return marker


def _marker(header: Header, name: str, kind: int, size: tuple[float, float, float], pose: Pose) -> Marker:
    red, green, blue, alpha = _COLOURS[name]
    return Marker(
        header=header, ns=name, id=0, type=kind, action=Marker.ADD, pose=pose,
        scale=Vector3(x=size[0], y=size[1], z=size[2]), color=ColorRGBA(r=red, g=green, b=blue, a=alpha),
    )  # fmt: skip


def _pose(x: float, y: float, z: float) -> Pose:
    return Pose(position=Point(x=float(x), y=float(y), z=float(z)))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(VizNode, args)


if __name__ == "__main__":
    leave(main())
