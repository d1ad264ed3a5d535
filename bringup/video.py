"""The node that makes a video: what the robot sees beside the view from above."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.synchroniser import Synchroniser
from mujoban_msgs_py.tick_node import live_qos
from mujoban_sim.grid import CONTROL_PERIOD

EDGE = 384
"""Pixels along the edges of each of the two pictures; a multiple of 16, as H.264 wants it."""


class VideoNode(Node):
    """Writes H.264 in MP4 at the speed of simulated time, in a pixel format that browsers play.

    Attributes:
        written: Stamp of the latest picture [ns].
    """

    def __init__(self, path: Path, **options: Any) -> None:
        """Open the file.

        Raises:
            ValueError: If its name does not end in .mp4.
            OSError: If its folder does not exist.
        """
        super().__init__("video", **options)
        if path.suffix != ".mp4":
            raise ValueError(f"{path}: expected a file name that ends in .mp4")
        if not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"{path}: no such folder {path.parent}")
        self._writer = imageio.get_writer(
            path, format="FFMPEG", fps=round(1 / CONTROL_PERIOD), codec="libx264", pixelformat="yuv420p",  # pyright: ignore
        )  # fmt: skip
        self.written = 0
        self._join: Synchroniser[NDArray[np.uint8]] = Synchroniser([topics.CAMERA.name, topics.TOP_CAMERA.name])
        for topic in (topics.CAMERA, topics.TOP_CAMERA):
            self.create_subscription(Image, topic.name, self._receiver(topic.name), live_qos(256))

    def destroy_node(self) -> None:
        """Finish the file."""
        self._writer.close()
        super().destroy_node()

    def _receiver(self, name: str) -> Callable[[Image], None]:
        def receive(message: Image) -> None:
            stamp = conversions.stamp_of(message)
            if stamp <= self.written:
                return
            pictures = self._join.add(name, stamp, conversions.frame_from_msg(message, None))
            if pictures is not None:
                self.written = stamp
                self._writer.append_data(side_by_side(pictures[topics.CAMERA.name], pictures[topics.TOP_CAMERA.name]))

        return receive


def side_by_side(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return two square pictures, [H, H, 3] each, enlarged and beside each other, [EDGE, 2 EDGE, 3]."""
    return np.concatenate([_enlarge(left), _enlarge(right)], axis=1)


def _enlarge(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with the nearest pixel everywhere: what the robot sees is not made smoother than it is."""
    rows = np.arange(EDGE) * picture.shape[0] // EDGE
    columns = np.arange(EDGE) * picture.shape[1] // EDGE
    return picture[rows[:, None], columns]
