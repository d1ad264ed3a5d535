"""The physics model of one level: walls, pegs, boxes and the robot, as one padded MJCF.

Every level with the same body and the same number K of boxes gives a model of the same layout, so that a
batch can run each simulation on its own level: walls are merged into rectangles, pegs that no box can touch
are left out, and both are filled up with geoms buried under the floor. Boxes that a level lacks are parked.

Coordinates: qpos holds, for each of K boxes, its slide joints x, y, z (x and y in the frame ``map``, z the
height of the underside), then the robot's positions (`mujoban_core.bodies`). qvel follows the same order.

Each box rests on one small sphere as its only contact with the floor. Boxes never turn, so nothing more is
needed, and the contact problem is a quarter of the size.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import ROBOT_DEFAULTS, Body
from mujoban_core.grid import GRID_SIZE, cell_to_xy
from mujoban_sim.presets import WorldPreset

_SETTLING_TIME: Final = 2.0

BOX_HALF_EXTENT: Final = (0.4, 0.4, 0.15)
"""Half edges of a box in cells."""
BOX_MASS: Final = 2.5
"""Mass of a box in kg, the same for every body (paper A.3)."""
FOOT_FRICTION: Final = 0.5
"""Sliding friction of a box on the floor, in every world."""
PEG_HALF_DIAGONAL: Final = 0.05
"""Half diagonal of a peg's square section in metres, the same for every body."""
PEG_HEIGHT: Final = 0.25
"""Height of a peg in metres, the same for every body."""
WALL_HEIGHT: Final = 1.0
"""Height of the physical walls in cells; drawn walls may be lower (`WorldPreset.drawn_wall_height`)."""

_PARKING: Final = 100.0
"""Boxes that a level lacks stand on the floor around (100, 100) cells, far outside the grid."""
BOX_COORDINATES: Final = 3
"""Positions, and velocities, of one box."""

# A row of ten cells holds at most five separate runs of wall, and every rectangle starts a run.
_WALL_CAPACITY: Final = GRID_SIZE * GRID_SIZE // 2
_PEG_CAPACITY: Final = (GRID_SIZE - 1) ** 2

# Contact bits: walls and pegs 1, boxes 2, floor 4, robot all. Boxes meet the floor through their feet only.
_TEMPLATE: Final = """
<mujoco>
  <option timestep="{step}" solver="Newton" cone="{cone}" integrator="Euler" noslip_iterations="{noslip}"/>
  <size memory="1M"/>
  <default>
    <geom friction="{friction} 0.005 0.0001"/>
    <default class="slide"><joint type="slide"/></default>
    <default class="static"><geom type="box" contype="1" conaffinity="3" condim="3"/></default>
    <default class="box">
      <geom {box_shape} contype="2" conaffinity="3" condim="3" mass="{box_mass}" priority="{box_priority}"
            friction="{box_friction} 0.005 0.0001"/>
    </default>
    <default class="foot">
      <geom type="sphere" size="0.02" pos="0 0 0.02" contype="0" conaffinity="0" mass="0"/>
    </default>
    {robot_defaults}
  </default>
  <asset>{box_asset}</asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" contype="4" conaffinity="4"/>
    {static}
    {boxes}
    {robot}
  </worldbody>
  <contact>{pairs}</contact>
  {actuator}
  {sensor}
</mujoco>
"""


def merge_walls(wall: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Cover the wall cells by disjoint rectangles (first row, first column, last row, last column).

    Args:
        wall: [N, N].
    """
    rest = wall.copy()
    rectangles = []
    for row, col in np.argwhere(wall).tolist():
        if not rest[row, col]:
            continue
        last_col = col
        while last_col + 1 < rest.shape[1] and rest[row, last_col + 1]:
            last_col += 1
        last_row = row
        while last_row + 1 < rest.shape[0] and rest[last_row + 1, col : last_col + 1].all():
            last_row += 1
        rest[row : last_row + 1, col : last_col + 1] = False
        rectangles.append((row, col, last_row, last_col))
    return rectangles


def peg_corners(wall: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the inner grid corners that need a peg, as the (row, column) of the cell north-west of each, [M, 2].

    A corner with three or four walls around it is a corner of the walls, which confine a box as a peg would.
    """
    around = wall[:-1, :-1].astype(np.int64) + wall[1:, :-1] + wall[:-1, 1:] + wall[1:, 1:]
    return np.argwhere(around < 3)


def scene_mjcf(wall: NDArray[np.bool_], max_boxes: int, body: Body, preset: WorldPreset) -> str:
    """Return the MJCF of the physics of a level; where boxes and robot stand is a matter of state.

    Args:
        wall: [N, N], N = `GRID_SIZE`.
        max_boxes: K, boxes in the layout.
        body: the robot's body.
        preset: the world's figures.

    Raises:
        ValueError: if the walls have another shape.
    """
    if wall.shape != (GRID_SIZE, GRID_SIZE):
        raise ValueError(f"walls have shape {wall.shape}: expected {(GRID_SIZE, GRID_SIZE)}")
    box_shape, box_asset = _box_shape(body.cell_size, preset.box_chamfer)
    return _TEMPLATE.format(
        step=preset.physics_step,
        cone=preset.cone,
        noslip=preset.noslip_iterations,
        friction=preset.friction,
        box_mass=BOX_MASS,
        box_friction=preset.box_friction,
        box_priority=int(preset.box_friction_prevails),
        box_shape=box_shape,
        box_asset=box_asset,
        robot_defaults=ROBOT_DEFAULTS,
        static="".join(_walls(wall, body.cell_size) + _pegs(wall, body.cell_size)),
        boxes="".join(_box(i, body.cell_size) for i in range(max_boxes)),
        robot=body.fragment(preset.robot),
        pairs="".join(_foot_pair(i) for i in range(max_boxes)),
        actuator=body.actuator_mjcf,
        sensor=body.sensor_mjcf,
    )


def _walls(wall: NDArray[np.bool_], cell_size: float) -> list[str]:
    geoms = []
    half_z = WALL_HEIGHT * cell_size / 2
    for row, col, last_row, last_col in merge_walls(wall):
        x, y = cell_to_xy([(row + last_row) / 2, (col + last_col) / 2], cell_size)
        half_x, half_y = (last_col - col + 1) * cell_size / 2, (last_row - row + 1) * cell_size / 2
        geoms.append(f'<geom class="static" pos="{x} {y} {half_z}" size="{half_x} {half_y} {half_z}"/>')
    for i in range(_WALL_CAPACITY - len(geoms)):
        geoms.append(f'<geom class="static" pos="{i} 0 -20" size="0.1 0.1 0.1"/>')
    return geoms


def _pegs(wall: NDArray[np.bool_], cell_size: float) -> list[str]:
    half_edge = PEG_HALF_DIAGONAL / np.sqrt(2)
    shape = f'class="static" euler="0 0 45" size="{half_edge} {half_edge} {PEG_HEIGHT / 2}"'
    centres = cell_to_xy(peg_corners(wall) + 0.5, cell_size)
    geoms = [f'<geom {shape} pos="{x} {y} {PEG_HEIGHT / 2}"/>' for x, y in centres]
    return geoms + [f'<geom {shape} pos="{i} 5 -20"/>' for i in range(_PEG_CAPACITY - len(geoms))]


def _box_shape(cell_size: float, chamfer: float) -> tuple[str, str]:
    """Return the attributes of a box's geom and the asset that they need; a plain box needs none."""
    if chamfer == 0.0:
        return f'type="box" size="{" ".join(f"{cell_size * half:.6g}" for half in BOX_HALF_EXTENT)}"', ""
    vertices = " ".join(f"{x:.6g}" for x in box_vertices(cell_size, chamfer).ravel())
    return 'type="mesh" mesh="box"', f'<mesh name="box" vertex="{vertices}"/>'


def box_vertices(cell_size: float, chamfer: float) -> NDArray[np.float64]:
    """Return the corners of a box with cut edges around its centre in metres, [16, 3]; it is their convex hull."""
    half = np.array(BOX_HALF_EXTENT)
    corners = np.stack([half - [chamfer, 0.0, 0.0], half - [0.0, chamfer, 0.0]])
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 1, 3)
    return cell_size * (signs * corners).reshape(-1, 3)


def _box(index: int, cell_size: float) -> str:
    # A millimetre of clearance under the box, so that the foot alone touches the floor.
    geom = f'name="box{index}" pos="0 0 {BOX_HALF_EXTENT[2] * cell_size + 0.001}"'
    joints = "".join(
        f'<joint name="box{index}_{name}" class="slide" axis="{axis}"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    return f'<body name="box{index}">{joints}<geom class="box" {geom}/><geom name="foot{index}" class="foot"/></body>'


def _foot_pair(index: int) -> str:
    friction = f"{FOOT_FRICTION} {FOOT_FRICTION} 0.005 0.0001 0.0001"
    return f'<pair geom1="foot{index}" geom2="floor" condim="3" friction="{friction}"/>'


def parked_position(index: int, cell_size: float) -> NDArray[np.float64]:
    """Return the slide joints (x, y, z) of an absent box in metres, [3]."""
    return np.array([_PARKING + 2 * index, _PARKING, 0.0]) * cell_size


def settled_positions(model: mujoco.MjModel, max_boxes: int, body: Body) -> NDArray[np.float64]:
    """Return the positions of parked boxes and a robot after their contacts have come to bear them, [nq].

    Args:
        model: a scene without walls.
        max_boxes: K, boxes in its layout.
        body: the robot's body.
    """
    data = mujoco.MjData(model)
    root = BOX_COORDINATES * max_boxes
    for k in range(max_boxes):
        data.qpos[BOX_COORDINATES * k :][:BOX_COORDINATES] = parked_position(k, body.cell_size)
    data.qpos[root:] = body.rest_qpos
    # Off the pegs: the centre of a cell.
    body.set_pose(data.qpos[root:], np.append(cell_to_xy([0, 0], body.cell_size), 0.0))
    mujoco.mj_step(model, data, round(_SETTLING_TIME / model.opt.timestep))
    return data.qpos.copy()


class SceneCache:
    """Compiled models by level, the least recently used dropped first.

    A batch keeps the models that it runs on alive itself, so dropping one here is always safe.
    """

    def __init__(self, body: Body, max_boxes: int, preset: WorldPreset, capacity: int = 32) -> None:
        """Compile models of a world for `body` and layouts of `max_boxes` boxes; keep at most `capacity` of them.

        They are of 0.3 MB each, and 2 ms make one anew.
        """
        if capacity < 1:
            raise ValueError(f"capacity of the scene cache is {capacity}: expected at least 1")
        self._body = body
        self._max_boxes = max_boxes
        self._preset = preset
        self._capacity = capacity
        self._models: OrderedDict[bytes, mujoco.MjModel] = OrderedDict()

    def model(self, wall: NDArray[np.bool_]) -> mujoco.MjModel:
        """Return the model of a level with the given walls, [N, N]."""
        key = wall.tobytes()
        model = self._models.get(key)
        if model is None:
            model = mujoco.MjModel.from_xml_string(scene_mjcf(wall, self._max_boxes, self._body, self._preset))
            self._models[key] = model
            if len(self._models) > self._capacity:
                self._models.popitem(last=False)
        else:
            self._models.move_to_end(key)
        return model
