"""Frames of many worlds from few OpenGL contexts: the robots' own cameras and a view from above.

A `FrameRenderer` draws any level with any appearance in any row. It has one OpenGL context per thread; each
draws its share of the rows from one `RenderScene`, in which a row is a slot.
"""

from __future__ import annotations

import importlib
import os
import weakref
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Final, Literal, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.bodies import FIRST_PERSON_CAMERA, Body
from mujoban_core.camera import FRAME_SIZE, TOP_DOWN_CAMERA, in_view
from mujoban_core.grid import GRID_SIZE, cell_to_xy
from mujoban_core.worker import Worker
from mujoban_sim import BACKENDS
from mujoban_sim.appearance import (
    BOX_COLOUR,
    BOX_ON_TARGET_COLOUR,
    PRESSED_TARGET_COLOUR,
    TARGET_COLOUR,
)
from mujoban_sim.presets import WorldPreset
from mujoban_sim.render_scene import UNSEEN_GROUP, build_scene, write_level
from mujoban_sim.scene import BOX_HALF_EXTENT
from mujoban_sokoban.levels import Level

CameraName = Literal["first_person", "top_down"]
CAMERAS: Final[tuple[CameraName, ...]] = (FIRST_PERSON_CAMERA, TOP_DOWN_CAMERA)
"""Names of the cameras: o_cam and o_top (paper appendix B)."""

_MAX_GEOMS: Final = 200


class RenderingError(OSError):
    """There is no OpenGL to draw with."""


class GLContext(Protocol):
    """An offscreen OpenGL context, of whichever of MuJoCo's backends."""

    def make_current(self) -> None:
        """Draw with it in the calling thread from now on."""
        ...

    def free(self) -> None:
        """Give it back."""
        ...


def open_context(size: int) -> GLContext:
    """Open an offscreen OpenGL context and make it current in the calling thread.

    The variable MUJOCO_GL chooses the library (``egl``, the default, ``osmesa`` or ``glfw``). Mesa's software
    renderer is told to draw in the calling thread: threads of its own cost more than they bring at this size. Its cache
    of shaders on disk, which makes nothing quicker here, is off: a thread of least priority keeps it, and no process
    ends before its last thread, which a busy machine gives its turn after seconds.

    Raises:
        RenderingError: if there is none; names the Debian packages to install.
    """
    backend = os.environ.get("MUJOCO_GL", "").strip().lower() or "egl"
    os.environ.setdefault("LP_NUM_THREADS", "0")
    os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")
    if backend not in BACKENDS:
        raise RenderingError(f"MUJOCO_GL is {backend!r}, expected one of {', '.join(BACKENDS)}, or nothing")
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(size, size)
        context.make_current()
    except Exception as error:
        # Missing libraries surface as ImportError, AttributeError or RuntimeError, depending on what is missing.
        raise RenderingError(
            f"cannot open an OpenGL context through {backend} ({error}): install the Debian packages libegl1 and "
            "libgl1-mesa-dri (apt-get install libegl1 libgl1-mesa-dri)"
        ) from error
    return context


class _Painter:
    """One OpenGL context with its scene; every call runs in its own thread, to which the context belongs."""

    def __init__(self, body: Body, max_boxes: int, slots: int, size: int, preset: WorldPreset) -> None:
        self._body = body
        self._preset = preset
        self._size = size
        self._slots = slots
        self._max_boxes = max_boxes
        self._worker = Worker("painter")
        self.submit = self._worker.submit
        try:
            # One job each: whoever ends the process in the meantime waits for one of them only.
            for part in (self._build, self._open, self._prepare):
                self.submit(part).result()
        except BaseException:
            self._worker.end()
            raise

    @property
    def qpos_size(self) -> int:
        """Return nq, the number of generalised positions."""
        return self._scene.model.nq

    def _build(self) -> None:
        self._scene = build_scene(self._body, self._max_boxes, self._slots, self._size, self._preset)

    def _open(self) -> None:
        self._gl = open_context(self._size)

    def _prepare(self) -> None:
        model = self._scene.model
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if self._context.currentBuffer != mujoco.mjtFramebuffer.mjFB_OFFSCREEN:
            raise RenderingError(f"OpenGL offers no offscreen buffer of {self._size} x {self._size} pixels")
        self._data = mujoco.MjData(model)
        self._perturb = mujoco.MjvPerturb()
        self._drawn = mujoco.MjvScene(model, _MAX_GEOMS)
        for flag in ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE"):
            self._drawn.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        self._cameras: dict[str, mujoco.MjvCamera] = {}
        self._options: dict[str, mujoco.MjvOption] = {}
        for name in CAMERAS:
            camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
            option.geomgroup[UNSEEN_GROUP] = name == TOP_DOWN_CAMERA
            self._cameras[name], self._options[name] = camera, option
        self._viewport = mujoco.MjrRect(0, 0, self._size, self._size)
        self._filter_texture(model.texture("skyline").id)

    def _filter_texture(self, index: int) -> None:
        """Take texels from one mipmap level instead of blending two: a software renderer draws 15 % faster."""
        # PyOpenGL chooses its platform when it is imported, which has to be after the context is open.
        from OpenGL import GL

        GL.glBindTexture(GL.GL_TEXTURE_2D, int(self._context.texture[index]))
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR_MIPMAP_NEAREST)

    def write(self, slot: int, level: Level, seed: int) -> None:
        """Put a level with an episode's appearance into a slot."""
        write_level(self._scene, slot, level.wall, seed)
        mujoco.mjr_uploadMesh(self._scene.model, self._context, slot)
        mujoco.mjr_uploadTexture(self._scene.model, self._context, slot)
        self._filter_texture(slot)

    def draw(
        self,
        slots: NDArray[np.int64],
        qpos: NDArray[np.float64],
        targets: NDArray[np.float64],
        rgba: NDArray[np.float32],
        camera: CameraName,
        out: NDArray[np.uint8],
    ) -> None:
        """Draw frames, bottom row first, into `out` [M, size, size, 3].

        Args:
            slots: [M].
            qpos: [M, nq].
            targets: centres of the pads [m], [M, K, 2].
            rgba: colours of boxes, then pads, [M, 2 K, 4]; alpha 0 leaves one out.
            camera: name of the camera.
            out: where to draw.
        """
        scene, model, data = self._scene, self._scene.model, self._data
        view, option = self._cameras[camera], self._options[camera]
        dataid, matid, geom_rgba, position = model.geom_dataid, model.geom_matid, model.geom_rgba, model.geom_pos
        movable = np.concatenate([scene.box_geoms, scene.target_geoms])
        everything = mujoco.mjtCatBit.mjCAT_ALL
        for i, slot in enumerate(slots.tolist()):
            dataid[scene.static_geom] = matid[scene.static_geom] = slot
            geom_rgba[movable] = rgba[i]
            position[scene.target_geoms, :2] = targets[i]
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            mujoco.mjv_updateScene(model, data, option, self._perturb, view, everything, self._drawn)
            mujoco.mjr_render(self._viewport, self._drawn, self._context)
            mujoco.mjr_readPixels(out[i], None, self._viewport, self._context)

    def close(self, *, wait: bool = True) -> None:
        """Free the context, in the thread to which it belongs, and end the thread."""
        freed = self.submit(self._close)
        self._worker.end()
        if wait:
            freed.result()

    def _close(self) -> None:
        self._context.free()
        self._gl.free()


class FrameRenderer:
    """Draws the frames of a batch of worlds.

    Rows are the worlds of a batch of B; each shows the level and appearance of its latest `set_episode`.
    """

    def __init__(
        self,
        batch: int,
        body: Body,
        max_boxes: int,
        size: int = FRAME_SIZE,
        threads: int = 1,
        *,
        preset: WorldPreset,
    ) -> None:
        """Open `threads` OpenGL contexts for `batch` worlds with up to `max_boxes` boxes and as many targets.

        Args:
            batch: B, number of worlds.
            body: the robot's body.
            max_boxes: K; qpos holds 3 K box positions and then the robot's.
            size: rows and columns of a frame.
            threads: frames of a batch are shared out among this many threads.
            preset: the world's figures.

        Raises:
            RenderingError: if there is no OpenGL.
            ValueError: if an argument is not positive.
        """
        for name, value in (("batch", batch), ("max_boxes", max_boxes), ("size", size), ("threads", threads)):
            if value < 1:
                raise ValueError(f"{name} is {value}: expected at least 1")
        self.batch, self.body, self.max_boxes, self.size = batch, body, max_boxes, size
        threads = min(threads, batch)
        # Row r is slot r // threads of painter r % threads.
        self._painters = [
            _Painter(body, max_boxes, len(range(first, batch, threads)), size, preset) for first in range(threads)
        ]
        self._qpos_size = self._painters[0].qpos_size
        # A context that the garbage collector frees, in whatever thread it happens to run, deletes buffers of the
        # context that is current there. So a renderer which was dropped is closed as one that was closed.
        self._finalizer = weakref.finalize(self, _abandon, self._painters)
        self._finalizer.atexit = False
        self._targets = np.zeros((batch, max_boxes, 2))
        self._has_target = np.zeros((batch, max_boxes), np.bool_)
        self._ready = np.zeros(batch, np.bool_)
        self._writing: list[Future[None]] = []

    def set_episode(self, row: int, level: Level, seed: int) -> None:
        """Show a level in a row from now on, with the textures of the episode's seed.

        Raises:
            ValueError: if the row does not exist, or the level has more targets than the layout.
        """
        if not 0 <= row < self.batch:
            raise ValueError(f"row is {row}: expected 0 to {self.batch - 1}")
        # Row-major order, as everywhere.
        targets = np.argwhere(level.target)
        if len(targets) > self.max_boxes:
            raise ValueError(f"the level has {len(targets)} targets: expected at most max_boxes = {self.max_boxes}")
        painter = self._painters[row % len(self._painters)]
        # Drawing waits for it: a painter's jobs run in their order.
        self._writing.append(painter.submit(painter.write, row // len(self._painters), level, seed))
        self._targets[row, : len(targets)] = cell_to_xy(targets, self.body.cell_size)
        self._has_target[row] = np.arange(self.max_boxes) < len(targets)
        self._ready[row] = True

    def render(
        self,
        qpos: NDArray[np.float64],
        pressed: NDArray[np.bool_],
        boxes_on_target: NDArray[np.bool_],
        rows: Sequence[int] | NDArray[np.int64] | None = None,
        camera: CameraName = FIRST_PERSON_CAMERA,
    ) -> NDArray[np.uint8]:
        """Draw the worlds as they are.

        Args:
            qpos: positions in the layout of physics, [B, nq].
            pressed: whether a box is on the target, targets in row-major order, [B, T] with T <= K.
            boxes_on_target: whether the box is on a target, [B, K].
            rows: which worlds to draw, [M]; all if None.
            camera: ``"first_person"`` (o_cam) or ``"top_down"`` (o_top, north up).

        Returns:
            RGB frames, row 0 at the top, [M, size, size, 3].

        Raises:
            ValueError: if a shape or the camera's name is wrong, or a row has no episode yet.
        """
        index = np.arange(self.batch) if rows is None else np.asarray(rows, np.int64)
        self._check(qpos, pressed, boxes_on_target, index, camera)
        qpos = np.ascontiguousarray(qpos[index])
        rgba = self._colours(pressed[index], boxes_on_target[index], index)
        rgba[..., 3] = self._visible(qpos, index, camera)
        while self._writing:
            self._writing.pop().result()
        frames = np.empty((len(index), self.size, self.size, 3), np.uint8)
        count = len(self._painters)
        jobs = []
        for number, painter in enumerate(self._painters):
            share = np.flatnonzero(index % count == number)
            if share.size:
                jobs.append(painter.submit(self._draw_share, painter, share, index, qpos, rgba, camera, frames))
        for job in jobs:
            job.result()
        return frames

    def _draw_share(
        self,
        painter: _Painter,
        share: NDArray[np.int64],
        index: NDArray[np.int64],
        qpos: NDArray[np.float64],
        rgba: NDArray[np.float32],
        camera: CameraName,
        frames: NDArray[np.uint8],
    ) -> None:
        """Draw the frames numbered `share` of a batch; runs in the painter's thread."""
        rows = index[share]
        drawn = np.empty((len(share), self.size, self.size, 3), np.uint8)
        painter.draw(rows // len(self._painters), qpos[share], self._targets[rows], rgba[share], camera, drawn)
        # OpenGL's first row is the bottom one.
        frames[share] = drawn[:, ::-1]

    def _colours(
        self, pressed: NDArray[np.bool_], on_target: NDArray[np.bool_], index: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return the colours of boxes and pads, [M, 2 K, 4]."""
        rgba = np.ones((len(index), 2 * self.max_boxes, 4), np.float32)
        boxes, pads = rgba[:, : self.max_boxes, :3], rgba[:, self.max_boxes :, :3]
        boxes[:] = np.where(on_target[..., None], BOX_ON_TARGET_COLOUR, BOX_COLOUR)
        pads[:] = TARGET_COLOUR
        count = pressed.shape[1]
        pads[:, :count] = np.where(pressed[..., None], PRESSED_TARGET_COLOUR, TARGET_COLOUR)
        return rgba

    def _visible(self, qpos: NDArray[np.float64], index: NDArray[np.int64], camera: CameraName) -> NDArray[np.bool_]:
        """Return which boxes and pads may show in a frame, [M, 2 K]; each one drawn costs time."""
        cell, k = self.body.cell_size, self.max_boxes
        boxes = qpos[:, : 3 * k].reshape(-1, k, 3)
        exists = np.concatenate(
            [np.abs(boxes[..., :2]).max(axis=-1) < GRID_SIZE * cell, self._has_target[index]], axis=1
        )
        if camera == TOP_DOWN_CAMERA or self.body.root != "slides":
            return exists
        pads = np.concatenate([self._targets[index], np.zeros((len(index), k, 1))], axis=-1)
        robot = qpos[:, 3 * k :]
        radius = np.repeat([np.linalg.norm(BOX_HALF_EXTENT) * cell, np.sqrt(0.5) * cell], k)
        centres = np.concatenate([boxes + np.array([0.0, 0.0, BOX_HALF_EXTENT[2] * cell]), pads], axis=1)
        return exists & in_view(centres, radius, robot[:, [0, 1, 3]], self.body.camera)

    def _check(
        self, qpos: ArrayLike, pressed: ArrayLike, on_target: ArrayLike, index: NDArray[np.int64], camera: str
    ) -> None:
        if camera not in CAMERAS:
            raise ValueError(f"unknown camera {camera!r}: expected one of {', '.join(CAMERAS)}")
        if np.shape(qpos) != (self.batch, self._qpos_size):
            raise ValueError(f"qpos has shape {np.shape(qpos)}: expected {(self.batch, self._qpos_size)}")
        if np.shape(on_target) != (self.batch, self.max_boxes):
            raise ValueError(
                f"boxes_on_target has shape {np.shape(on_target)}: expected {(self.batch, self.max_boxes)}"
            )
        if np.ndim(pressed) != 2 or np.shape(pressed)[0] != self.batch or np.shape(pressed)[1] > self.max_boxes:
            raise ValueError(f"pressed has shape {np.shape(pressed)}: expected [{self.batch}, T <= {self.max_boxes}]")
        if index.size and (index.min() < 0 or index.max() >= self.batch):
            raise ValueError(f"rows are {index.tolist()}: expected values from 0 to {self.batch - 1}")
        if not self._ready[index].all():
            raise ValueError(f"rows {index[~self._ready[index]].tolist()} have no episode yet: call set_episode first")

    def close(self) -> None:
        """Free the contexts; the renderer cannot be used afterwards."""
        if self._finalizer.detach() is not None:
            for painter in self._painters:
                painter.close()
        self._painters = []


def _abandon(painters: Sequence[_Painter]) -> None:
    """Close painters without waiting for them: this may run in the thread of one."""
    for painter in painters:
        painter.close(wait=False)
