"""The node that makes a video: what the robot sees beside the view from above, and what the modules say of it."""

from __future__ import annotations

import errno
import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Unpack

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from bringup.overlay import Said, draw, name_told
from mujoban_core.grid import CONTROL_PERIOD
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.run_identifier import ANY
from mujoban_msgs_py.runtime.descriptors import NodeOptions
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.tick_node import live_qos
from mujoban_msgs_py.synchroniser import Synchroniser

EDGE: Final = 384
"""Pixels along the edges of each of the two pictures; a multiple of 16, as H.264 wants it."""
PATIENCE: Final = 16
"""Pictures that wait at most for what the modules say: in real time an answer may never come."""

_frame = partial(conversions.frame_from_msg, size=None)
_SEEN: Final = {topics.CAMERA: _frame, topics.TOP_CAMERA: _frame, topics.EPISODE: conversions.episode_from_msg}
_FRAGMENTS: Final = ["-movflags", "+frag_keyframe+empty_moov+default_base_moof", "-g", "100"]
"""A film of parts of 5 s, each of which can be played without those after it: on a full disk it is shorter."""
_FULL: Final = 1 << 20
"""Bytes left on a disk below which a writer that fails has found it full."""
_SAID: Final = {
    topics.INSTRUCTION: conversions.instruction_from_msg,
    topics.TERMINATION: conversions.termination_from_msg,
    topics.ABSTRACT_STATE: conversions.abstract_state_from_msg,
}


class _Picture(NamedTuple):
    """A picture without its overlay."""

    pixels: NDArray[np.uint8]
    step: int
    last: bool
    """Whether the episode ended here, so that no module has anything to say."""


class VideoNode(GraphNode):
    """Writes H.264 in MP4 at the speed of simulated time, in a pixel format that browsers play.

    Attributes:
        written: Stamp of the latest picture [ns].
    """

    def __init__(
        self,
        path: Path,
        *,
        alone: bool = False,
        told: Sequence[str] = (),
        run: int = ANY,
        **options: Unpack[NodeOptions],
    ) -> None:
        """Open the file.

        Args:
            path: Of the video.
            alone: Whether an agent plays alone, and there are no modules whose word could be waited for.
            told: Roles that are told the ground truth, which every picture says.
            run: Identifier of the run that is filmed, if it is known.
            **options: Of the node.

        Raises:
            ValueError: If its name does not end in .mp4.
            OSError: If its folder does not exist.
        """
        super().__init__("video", **options)
        self.run = run
        self.counts: Counter[str] = Counter()
        if path.suffix != ".mp4":
            raise ValueError(f"{path}: expected a file name that ends in .mp4")
        if not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"{path}: no such folder {path.parent}")
        self._writer = imageio.get_writer(
            path, format="FFMPEG", fps=round(1 / CONTROL_PERIOD), codec="libx264", pixelformat="yuv420p",  # pyright: ignore
            output_params=_FRAGMENTS,
        )  # fmt: skip
        self._path, self._failed = path.absolute(), False
        self.written = 0
        self._waiting: dict[int, _Picture] = {}
        self._said: dict[int, Said] = {}
        self._latest: Said | None = None
        self._told = tuple(told)
        self._patience = 0 if alone else PATIENCE
        said = [] if alone else [(self._on_said, _SAID)]
        for handle, parts in ((self._on_seen, _SEEN), *said):
            join: Synchroniser[Any] = Synchroniser([topic.name for topic in parts])
            for topic, decode in parts.items():
                listen(self, topic, self._receiver(join, topic.name, handle), qos=live_qos(256), decode=decode)

    def destroy_node(self) -> None:
        """Finish the file."""
        if not self._failed:
            self._write(patience=0)
        self._writer.close()
        super().destroy_node()

    def _receiver(
        self,
        join: Synchroniser[Any],
        name: str,
        handle: Callable[[int, dict[str, Any]], None],
    ) -> Callable[[Received], None]:
        def receive(message: Received) -> None:
            if message.stamp <= self.written:
                return
            parts = join.add(name, message.stamp, message.content)
            if parts is not None:
                handle(message.stamp, parts)
                self._write(self._patience)

        return receive

    def _on_seen(self, stamp: int, parts: dict[str, Any]) -> None:
        episode: conversions.EpisodeReading = parts[topics.EPISODE.name]
        pixels = side_by_side(parts[topics.CAMERA.name], parts[topics.TOP_CAMERA.name])
        self._waiting[stamp] = _Picture(pixels, episode.step, episode.ended)

    def _on_said(self, stamp: int, parts: dict[str, Any]) -> None:
        instruction: conversions.InstructionReading = parts[topics.INSTRUCTION.name]
        probability = parts[topics.TERMINATION.name].probability
        estimate = parts[topics.ABSTRACT_STATE.name]
        self._said[stamp] = Said(instruction.direction, instruction.sequence, probability, estimate)

    def _write(self, patience: int) -> None:
        """Write the pictures, in order, whose overlay is known or has been waited for long enough."""
        while self._waiting:
            stamp, picture = next(iter(self._waiting.items()))
            if stamp not in self._said and not picture.last and len(self._waiting) <= patience:
                return
            del self._waiting[stamp]
            self._latest = self._said.get(stamp, self._latest)
            self._said = {later: said for later, said in self._said.items() if later > stamp}
            seen, above = picture.pixels[:, :EDGE], name_told(picture.pixels[:, EDGE:], self._told)
            if self._latest is not None:
                seen = draw(seen, self._latest, picture.step)
            pixels = np.concatenate([seen, above], axis=1)
            try:
                self._writer.append_data(pixels)
            except OSError as error:
                self._failed = True
                full = shutil.disk_usage(self._path.parent).free < _FULL
                why = os.strerror(errno.ENOSPC) if full else str(error).split("\n")[0]
                raise OSError(f"{self._path}: the video ends before step {picture.step}: {why}") from error
            self.written = stamp


def side_by_side(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return two square pictures, [H, H, 3] each, enlarged and beside each other, [EDGE, 2 EDGE, 3]."""
    return np.concatenate([_enlarge(left), _enlarge(right)], axis=1)


def _enlarge(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture with the nearest pixel everywhere: what the robot sees is not made smoother than it is."""
    rows = np.arange(EDGE) * picture.shape[0] // EDGE
    columns = np.arange(EDGE) * picture.shape[1] // EDGE
    return picture[rows[:, None], columns]
