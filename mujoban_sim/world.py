"""Batched physical Sokoban: physics, observations, rewards and ground truth of B robots (paper appendix B).

Shapes: B robots, K boxes, P proprioceptive values, U actuators, N rows and columns of the grid, M selected rows.
All positions are metres in the frame ``map``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike, NDArray

from mujoban_core import grid
from mujoban_core.bodies import FIRST_PERSON_CAMERA, get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import AGENT, CHANNELS, COMPLETION_TOLERANCE, GRID_SIZE, TARGET, WALL, cell_to_xy, xy_to_cell
from mujoban_core.interfaces import GroundTruth, Observation
from mujoban_sim.cameras import Cameras
from mujoban_sim.checks import check_places, check_rows, hand_over_torque
from mujoban_sim.goals import MAX_BOX_SPEED, GoalKind, GoalTracker
from mujoban_sim.presets import DEFAULT_WORLD, get_world
from mujoban_sim.scene import BOX_COORDINATES, SceneCache, settled_positions
from mujoban_sim.snapshots import Portable, Snapshot, check_snapshot, decode_episodes, encode_episodes
from mujoban_sim.world_kernels import KernelState, pack, update
from mujoban_sokoban.episodes import EpisodeSpec, check_levels

if TYPE_CHECKING:
    from mujoban_sim.rendering import CameraName

_STAGE_NONE: Final = int(mujoco.mjtStage.mjSTAGE_NONE)
_STAGE_VELOCITY: Final = int(mujoco.mjtStage.mjSTAGE_VEL)
_HEADING_STREAM: Final = 1
"""Tells the heading's random stream from others that an episode's seed governs, but for the generator's of levels of
difficulty 1, which is the same: their robots' headings go with the first step of the walk that makes the room."""


_DYNAMIC: Final = (
    "pose", "velocity", "proprio", "box_position", "box_speed", "agent_cell", "box_cell", "box_on_target",
    "boxes_on_target", "_abstract_state", "reward", "episode_return", "steps", "solved", "truncated",
)  # fmt: skip
"""Attributes that change within an episode, besides those of physics and goals."""


def initial_heading(seed: int) -> float:
    """Return the robot's heading psi at the start of the episode with the given seed, in [-pi, pi)."""
    return float(np.random.default_rng([_HEADING_STREAM, seed]).uniform(-np.pi, np.pi))


class World(Portable):
    """B independent Mujoban worlds that step together at 20 Hz.

    A row is an episode: `reset` starts it, `instruct` tells which instruction it follows, `step` applies
    torques. A row whose episode has ended (solved or truncated) stands still, without reward, until it is
    reset. The same level, seed and torques give the same values exactly, in every process and whatever ran in
    the row before.

    The arrays are live: they change in place. Copy what you keep (`observation` and `truth` return copies).

    Attributes:
        body: the robot's `Body`.
        preset: the physical world's figures.
        pose: (x [m], y [m], psi [rad], in [-pi, pi]) of the robot, float32 [B, 3].
        velocity: (vx [m/s], vy [m/s], yaw rate [rad/s]) in the map frame, float32 [B, 3].
        proprio: o_pr, layout in `mujoban_core.bodies.ProprioSlices`, float32 [B, P].
        box_position: o_box, float32 [B, K, 2]; boxes that a level lacks lie far outside the grid.
        box_speed: [m/s], float32 [B, K].
        box_count: boxes of each level, int64 [B].
        wall: bool [B, N, N].
        target: bool [B, N, N].
        agent_cell: (row, column) of the robot, int64 [B, 2]. If it rounds into a box's cell it keeps its last cell.
        box_cell: (row, column) of the boxes, int64 [B, K, 2]; (-1, -1) for those that a level lacks.
        box_on_target: bool [B, K]. A box is on a target when at least half of it in both axes lies within the pad.
        boxes_on_target: number of targets with a box on them, int64 [B].
        reward: of the last step: +1 for a box onto a target, -1 off one, +10 for solving; float32 [B].
        episode_return: sum of the rewards, float32 [B].
        steps: steps of the episode so far, int64 [B].
        solved: whether all boxes have been on targets at once, which ends the episode; bool [B].
        truncated: whether the time limit ended the episode, bool [B].
        goals: goals of the instructions in force.
    """

    def __init__(
        self,
        batch: int,
        *,
        body: str = "ball",
        world: str = DEFAULT_WORLD,
        max_boxes: int = grid.MAX_BOXES,
        time_limit: int | None = None,
        threads: int = 1,
        tolerance: float = COMPLETION_TOLERANCE,
        max_box_speed: float = MAX_BOX_SPEED,
    ) -> None:
        """Make B worlds; every row must be reset before the first step.

        Args:
            batch: B.
            body: name of the robot's body, a key of `mujoban_core.bodies.BODIES`.
            world: name of the physical world, a key of `mujoban_sim.presets.WORLDS`.
            max_boxes: K, the most boxes of any level to be played.
            time_limit: steps after which an episode is truncated; None: the body's (240 s for the ball).
            threads: threads for physics; the results do not depend on it.
            tolerance: tolerance of the completion rule in cells.
            max_box_speed: speed in cells per second below which a pushed box counts as placed.

        Raises:
            ValueError: if an argument is out of its range.
        """
        for name, value in (("batch", batch), ("max_boxes", max_boxes), ("threads", threads)):
            if value < 1:
                raise ValueError(f"{name} is {value}: expected at least 1")
        self.body = get_body(body)
        self.preset = get_world(world)
        self.batch = batch
        self.max_boxes = max_boxes
        self.time_limit = self.body.time_limit if time_limit is None else time_limit
        if not isinstance(self.time_limit, int | np.integer) or self.time_limit < 1:
            raise ValueError(f"time_limit is {time_limit}: expected a whole number of steps, at least 1")
        self.goals = GoalTracker(batch, cell_size=self.body.cell_size, tolerance=tolerance, max_box_speed=max_box_speed)
        self._threads = threads
        self._all_rows = self._live = np.arange(batch)
        self._cameras = Cameras(batch, self.body, max_boxes, threads, self.preset)
        self._episodes: list[EpisodeSpec | None] = [None] * batch
        self._started = False
        self._allocate()
        self._start_physics()

    def _allocate(self) -> None:
        b, k, n = self.batch, self.max_boxes, GRID_SIZE
        self.pose = np.zeros((b, 3), np.float32)
        self.velocity = np.zeros((b, 3), np.float32)
        self.proprio = np.zeros((b, self.body.proprio_size), np.float32)
        self.box_position = np.zeros((b, k, 2), np.float32)
        self.box_speed = np.zeros((b, k), np.float32)
        self.box_count = np.zeros(b, np.int64)
        self.wall = np.ones((b, n, n), np.bool_)
        self.target = np.zeros((b, n, n), np.bool_)
        self.agent_cell = np.zeros((b, 2), np.int64)
        self.box_cell = np.full((b, k, 2), -1, np.int64)
        self._target_cell = np.full((b, k, 2), -1, np.int64)
        self.box_on_target = np.zeros((b, k), np.bool_)
        self.boxes_on_target = np.zeros(b, np.int64)
        self._abstract_state = np.zeros((b, n, n, len(CHANNELS)), np.float32)
        self.reward = np.zeros(b, np.float32)
        self.episode_return = np.zeros(b, np.float32)
        self.steps = np.zeros(b, np.int64)
        self.solved = np.zeros(b, np.bool_)
        self.truncated = np.zeros(b, np.bool_)

    def _start_physics(self) -> None:
        self._scenes = SceneCache(self.body, self.max_boxes, self.preset)
        empty = self._scenes.model(np.zeros((GRID_SIZE, GRID_SIZE), np.bool_))
        self._models = [empty] * self.batch
        # Each row keeps its MjData, so that sensors at the new state cost no second pass.
        self._physics = Batch(empty, nsim=self.batch, nthread=self._threads, persistent=True)
        self._qpos = self._physics.bind("qpos")
        self._qvel = self._physics.bind("qvel")
        self._ctrl = self._physics.bind("ctrl")
        self._sensors = self._physics.bind("sensordata")
        self._root = BOX_COORDINATES * self.max_boxes
        self._rest_qpos = settled_positions(empty, self.max_boxes, self.body)
        body, goals = self.body, self.goals
        self._kernel_state = pack(KernelState(
            qpos=self._qpos, qvel=self._qvel, sensors=self._sensors, root=self._root, free_root=body.root == "free",
            joint_qpos=np.array(body.joint_qpos, np.int64), joint_qvel=np.array(body.joint_qvel, np.int64),
            cell_size=body.cell_size, time_limit=self.time_limit, box_count=self.box_count, target=self.target,
            kind=goals.kind, robot_target=goals.robot_target, box_index=goals.box_index, box_target=goals.box_target,
            tolerance=goals.tolerance, max_box_speed=goals.max_box_speed, reached=goals.reached, pose=self.pose,
            velocity=self.velocity, proprio=self.proprio, box_position=self.box_position, box_speed=self.box_speed,
            agent_cell=self.agent_cell, box_cell=self.box_cell, box_on_target=self.box_on_target,
            boxes_on_target=self.boxes_on_target, abstract_state=self._abstract_state, reward=self.reward,
            episode_return=self.episode_return, steps=self.steps, solved=self.solved, truncated=self.truncated,
        ))  # fmt: skip

    @property
    def completed(self) -> NDArray[np.bool_]:
        """Whether the instruction in force is completed by the rule of paper C.4, as of the last step, [B]."""
        return self.goals.reached

    @property
    def done(self) -> NDArray[np.bool_]:
        """Whether the episode has ended, [B]."""
        return self.solved | self.truncated

    @property
    def qpos(self) -> NDArray[np.float64]:
        """Generalised positions in the layout of `mujoban_sim.scene`, [B, nq]; read only, please."""
        return self._qpos

    @property
    def episodes(self) -> Sequence[EpisodeSpec | None]:
        """The episode that each row plays; None where none has been started."""
        return self._episodes

    def reset(self, rows: ArrayLike, episodes: Sequence[EpisodeSpec]) -> None:
        """Start episodes.

        Args:
            rows: rows to restart, int [M].
            episodes: their episodes.

        Raises:
            ValueError: if the numbers differ, a row is out of range or appears twice, or a level has too many boxes.
        """
        chosen = check_rows(rows, self.batch)
        if len(chosen) != len(episodes):
            raise ValueError(f"{len(chosen)} rows but {len(episodes)} episodes: expected one each")
        self._begin(chosen, episodes)
        for counter in (self.reward, self.episode_return, self.steps, self.solved, self.truncated):
            counter[chosen] = 0
        self._live = np.flatnonzero(~self.done)
        self.goals.reset(chosen)
        pose = np.zeros((len(chosen), 3))
        boxes = np.zeros((len(chosen), self.max_boxes, 2))
        for m, episode in enumerate(episodes):
            pose[m, :2] = cell_to_xy(episode.level.player, self.body.cell_size)
            pose[m, 2] = initial_heading(episode.seed)
            boxes[m, : len(episode.level.boxes)] = cell_to_xy(episode.level.boxes, self.body.cell_size)
        self._write_state(chosen, pose, boxes)

    def _begin(self, rows: NDArray[np.int64], episodes: Sequence[EpisodeSpec]) -> None:
        """Put the levels of episodes into rows."""
        check_levels(episodes, self.max_boxes)
        models = [self._scenes.model(e.level.wall) for e in episodes]
        for row, episode, model in zip(rows.tolist(), episodes, models, strict=True):
            level = episode.level
            self._episodes[row] = episode
            self._models[row] = model
            self.wall[row], self.target[row] = level.wall, level.target
            self._abstract_state[row] = 0.0
            self._abstract_state[row, ..., WALL], self._abstract_state[row, ..., TARGET] = level.wall, level.target
            self.box_count[row] = len(level.boxes)
            self._target_cell[row] = -1
            self._target_cell[row, : len(level.boxes)] = np.argwhere(level.target)
            self.agent_cell[row] = level.player
        self._started = self._started or None not in self._episodes
        self._cameras.renew(rows)
        self._physics.set_models(self._models)

    def place(self, rows: ArrayLike, pose: ArrayLike, box_position: ArrayLike) -> None:
        """Put robots and boxes somewhere, at rest, without reward; the instructions in force stay.

        Args:
            rows: int [M].
            pose: (x [m], y [m], psi [rad]) of the robots, [M, 3].
            box_position: [M, K, 2] in metres; those of boxes that a level lacks are ignored.

        Raises:
            ValueError: if a shape is wrong, a number is not finite, a robot or a box is off the grid, or a row has no
                episode.
        """
        chosen = check_rows(rows, self.batch)
        poses, boxes = np.asarray(pose, np.float64), np.asarray(box_position, np.float64)
        check_places(poses, boxes, np.arange(self.max_boxes) < self.box_count[chosen, None], self.body.cell_size)
        if any(self._episodes[row] is None for row in chosen.tolist()):
            raise ValueError("cannot place robots in rows without an episode: call reset first")
        self._abstract_state[chosen, :, :, AGENT] = 0.0
        self.agent_cell[chosen] = xy_to_cell(poses[:, :2], self.body.cell_size)
        self._write_state(chosen, poses, boxes)

    def _write_state(self, rows: NDArray[np.int64], pose: NDArray[np.float64], boxes: NDArray[np.float64]) -> None:
        # Resetting also clears warm starts and whatever else a row's MjData remembers.
        self._physics.reset(ids=rows, stage=_STAGE_NONE)
        root, body = self._root, self.body
        for m, row in enumerate(rows.tolist()):
            q, count = self._qpos[row], self.box_count[row]
            q[:] = self._rest_qpos
            q[:root].reshape(-1, BOX_COORDINATES)[:count, :2] = boxes[m, :count]
            body.set_pose(q[root:], pose[m])
        self._physics.forward(ids=rows)
        update(rows, False, self._kernel_state)

    def snapshot(self, rows: ArrayLike) -> Snapshot:
        """Return everything that decides how the given rows, int [M], go on, as arrays with M on the first axis.

        A world of the same body, preset, boxes and settings that restores it continues to the last bit.

        Raises:
            ValueError: if a row is out of range or has no episode.
        """
        chosen = check_rows(rows, self.batch)
        episodes = [self._episodes[row] for row in chosen.tolist()]
        return {name: array[chosen] for name, array in self._dynamic().items()} | encode_episodes(episodes)

    def restore(self, rows: ArrayLike, snapshot: Snapshot) -> None:
        """Bring rows, int [M], into the state of a `snapshot`, instructions in force included.

        Raises:
            ValueError: if a row is out of range, or the snapshot is not one of M rows of such a world; nothing has
                changed then.
        """
        chosen, dynamic = check_rows(rows, self.batch), self._dynamic()
        ranges = {
            "agent_cell": (0, GRID_SIZE - 1), "box_cell": (-1, GRID_SIZE - 1),
            "goals.kind": (min(GoalKind), max(GoalKind)), "goals.box_index": (0, self.max_boxes - 1),
        }  # fmt: skip
        check_snapshot(snapshot, len(chosen), dynamic, ranges)
        self._begin(chosen, decode_episodes(snapshot))
        self._physics.reset(ids=chosen, stage=_STAGE_NONE)
        for name, array in dynamic.items():
            array[chosen] = snapshot[name]
        self._live = np.flatnonzero(~self.done)

    def _dynamic(self) -> dict[str, NDArray[Any]]:
        """Return the arrays, each [B, ...], that change within an episode."""
        return {
            **{name: self._physics.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")},
            **{name: getattr(self, name) for name in _DYNAMIC},
            **{f"goals.{name}": array for name, array in self.goals.arrays().items()},
        }

    def instruct(self, instruction: NDArray[np.int64], issued: NDArray[np.bool_]) -> None:
        """Tell which instructions A_t the coming steps follow.

        Args:
            instruction: A_t, int64 [B].
            issued: where A_t is a new instruction, bool [B]; it may equal the one before.

        Raises:
            ValueError: if a new instruction is not one of `Instruction`.
        """
        rows = np.flatnonzero(issued)
        if rows.size:
            self.goals.begin(rows, np.asarray(instruction, np.int64), self.wall, self.agent_cell, self.box_cell)

    def step(self, torque: NDArray[np.float32]) -> None:
        """Apply torques for one control period of 50 ms.

        Args:
            torque: normalised to [-1, 1], [B, U].

        Raises:
            TorqueError: if they have another shape, are not finite or lie outside [-1, 1]; nothing has moved then.
            RuntimeError: if a row has never been reset.
        """
        if not self._started:
            raise RuntimeError("rows without an episode: call reset on all rows before step")
        hand_over_torque(np.asarray(torque), self._ctrl)
        live = self._live
        if len(live) == self.batch:
            self._physics.step(nstep=self.preset.substeps, stage=_STAGE_VELOCITY)
        else:
            self.reward[:] = 0.0
            self._physics.step(ids=live, nstep=self.preset.substeps, stage=_STAGE_VELOCITY)
        if update(live, True, self._kernel_state):
            self._live = np.flatnonzero(~self.done)

    def abstract_state(self) -> NDArray[np.float32]:
        """Return a copy of s_abst, binary, [B, N, N, 4]."""
        return self._abstract_state.copy()

    def truth(self, rows: NDArray[np.int64] | None = None) -> GroundTruth:
        """Return a copy of what only the simulator knows, of all rows or of some, [M, ...] each."""
        m = self._all_rows if rows is None else rows
        return GroundTruth(
            self._abstract_state[m], self.pose[m], self.velocity[m], self.box_position[m], self.completed[m]
        )

    def observation(self) -> Observation:
        """Return a copy of what the robots perceive; draws their frames."""
        return Observation(self.render(), self.proprio.copy(), self.pose.copy())

    def render(
        self, camera: CameraName = FIRST_PERSON_CAMERA, rows: ArrayLike | None = None, size: int = FRAME_SIZE
    ) -> NDArray[np.uint8]:
        """Draw the worlds; the first call opens OpenGL.

        Args:
            camera: ``"first_person"`` (o_cam) or ``"top_down"`` (o_top, north up).
            rows: rows to draw, int [M]; None: all.
            size: rows and columns of a frame.

        Returns:
            RGB frames, uint8 [M, size, size, 3].

        Raises:
            RenderingError: if there is no OpenGL.
            ValueError: if an argument is out of its range or a row has never been reset.
        """
        chosen = self._all_rows if rows is None else check_rows(rows, self.batch)
        return self._cameras.render(
            camera, size, chosen, self._episodes, self._qpos, self._pressed(), self.box_on_target
        )

    def _pressed(self) -> NDArray[np.bool_]:
        """Return which pads carry a box, pads in row-major order, [B, K]."""
        # Shape [B, K, K]: pad t against box k.
        same = (self._target_cell[:, :, None] == self.box_cell[:, None]).all(-1)
        return (same & self.box_on_target[:, None]).any(-1)

    def close(self) -> None:
        """Free the OpenGL contexts; they open again when needed."""
        self._cameras.close()
