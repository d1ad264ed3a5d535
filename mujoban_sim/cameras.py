"""The renderers of a batch of worlds, one for each size of frame, opened when a frame of that size is first wanted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_sim.presets import WorldPreset
from mujoban_sokoban.episodes import EpisodeSpec

if TYPE_CHECKING:
    from mujoban_sim.rendering import CameraName, FrameRenderer


class Cameras:
    """Draws B worlds; a level is handed to a renderer when a row that plays it is drawn."""

    def __init__(self, batch: int, body: Body, max_boxes: int, threads: int, preset: WorldPreset) -> None:
        """Open nothing yet: worlds without a camera need no OpenGL."""
        self._batch, self._body, self._max_boxes = batch, body, max_boxes
        self._threads, self._preset = threads, preset
        self._renderers: dict[int, FrameRenderer] = {}
        self._undrawn: dict[int, set[int]] = {}

    def renew(self, rows: NDArray[np.int64]) -> None:
        """Note that rows, [M], play other episodes from now on."""
        for undrawn in self._undrawn.values():
            undrawn.update(rows.tolist())

    def render(
        self,
        camera: CameraName,
        size: int,
        rows: NDArray[np.int64],
        episodes: Sequence[EpisodeSpec | None],
        qpos: NDArray[np.float64],
        pressed: NDArray[np.bool_],
        box_on_target: NDArray[np.bool_],
    ) -> NDArray[np.uint8]:
        """Draw rows, [M], as RGB frames, uint8 [M, size, size, 3]; see `FrameRenderer.render` for the rest.

        Raises:
            RenderingError: if there is no OpenGL.
            ValueError: if an argument is out of its range or a row has no episode.
        """
        renderer = self._renderer(size)
        undrawn = self._undrawn[size]
        for row in undrawn.intersection(rows.tolist()):
            episode = episodes[row]
            if episode is None:
                raise ValueError(f"row {row} has no episode: call reset before render")
            renderer.set_episode(row, episode.level, episode.seed)
            undrawn.discard(row)
        return renderer.render(qpos, pressed, box_on_target, rows, camera)

    def _renderer(self, size: int) -> FrameRenderer:
        if size not in self._renderers:
            from mujoban_sim.rendering import FrameRenderer

            self._renderers[size] = FrameRenderer(
                self._batch, self._body, self._max_boxes, size, self._threads, preset=self._preset
            )
            self._undrawn[size] = set(range(self._batch))
        return self._renderers[size]

    def close(self) -> None:
        """Free the OpenGL contexts; they open again when needed."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self._undrawn.clear()
