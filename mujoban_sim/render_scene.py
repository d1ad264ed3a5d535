"""The model that is drawn: boxes and robot with the joints of physics, and slots for static levels.

It shares the layout of qpos with `mujoban_sim.scene` and has nothing else in common with physics. The static
part of a level is a mesh and a texture in a *slot*: both are rewritten in place when an episode starts, and the
one geom that shows them is switched between slots from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import ROBOT_BODY, ROBOT_DEFAULTS, Body
from mujoban_core.camera import TOP_DOWN_CAMERA, in_view
from mujoban_core.grid import GRID_SIZE
from mujoban_sim.appearance import SKYLINE_SHAPE, Atlas, draw_skyline
from mujoban_sim.meshes import MAX_QUADS, Mesh, level_mesh, skyline_mesh
from mujoban_sim.presets import WorldPreset
from mujoban_sim.scene import BOX_HALF_EXTENT, box_vertices

UNSEEN_GROUP: Final = 1
"""Geom group of what the first-person camera never sees."""
_TOP_DOWN_HEIGHT: Final = 16.0
_PAD_THICKNESS: Final = 0.004
_NEAR, _FAR = 0.02, 200.0


@dataclass(frozen=True)
class RenderScene:
    """A model to draw from, and where its parts are."""

    model: mujoco.MjModel
    static_geom: int
    skyline_geom: int
    box_geoms: NDArray[np.int64]
    target_geoms: NDArray[np.int64]
    cell_size: float
    atlas: Atlas


def _mjcf(body: Body, max_boxes: int, size: int, preset: WorldPreset) -> str:
    cell = body.cell_size
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    boxes = "".join(
        f'<body>{slides}<geom name="box{i}" size="{cell}" pos="0 0 {BOX_HALF_EXTENT[2] * cell}"/></body>'
        for i in range(max_boxes)
    )
    pads = "".join(
        f'<geom name="target{i}" type="box" size="{cell / 2} {cell / 2} {_PAD_THICKNESS}"/>' for i in range(max_boxes)
    )
    height = _TOP_DOWN_HEIGHT * cell
    half_width = GRID_SIZE / 2 * cell
    fovy = 2 * np.degrees(np.arctan2(half_width, height - preset.drawn_wall_height * cell))
    scale = max(cell, 1.0)
    return f"""
<mujoco>
  <compiler autolimits="true" boundmass="0.001" boundinertia="0.001"/>
  <statistic extent="1" center="0 0 0"/>
  <visual>
    <global offwidth="{size}" offheight="{size}"/>
    <map znear="{_NEAR}" zfar="{_FAR * scale}"/>
    <headlight ambient="0.8 0.8 0.8" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <quality shadowsize="0" offsamples="0"/>
  </visual>
  <default>{ROBOT_DEFAULTS}</default>
  <worldbody>
    <camera name="{TOP_DOWN_CAMERA}" pos="0 0 {height}" xyaxes="1 0 0 0 1 0" fovy="{fovy}"/>
    {pads}{boxes}{body.fragment(preset.robot)}
  </worldbody>
</mujoco>"""


def _add_mesh(spec: mujoco.MjSpec, name: str, mesh: Mesh, texture_shape: tuple[int, int, int]) -> None:
    """Add a textured mesh and the material that carries its texture, both called `name`."""
    spec.add_mesh(
        name=name,
        uservert=mesh.vertices.ravel().tolist(),
        usernormal=mesh.normals.ravel().tolist(),
        usertexcoord=mesh.texcoords.ravel().tolist(),
        userface=mesh.faces.ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        height=texture_shape[0],
        width=texture_shape[1],
        nchannel=texture_shape[2],
    )
    material = spec.add_material(name=name, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _blank_mesh() -> Mesh:
    """Return a mesh of the capacity that any level fits in."""
    corners = np.random.default_rng(0).random((4 * MAX_QUADS, 3), dtype=np.float32)
    faces = np.arange(4 * MAX_QUADS, dtype=np.int32)[: 4 * MAX_QUADS // 3 * 3].reshape(-1, 3)
    fill = np.tile(np.array([[0, 1, 2]], np.int32), (2 * MAX_QUADS - len(faces), 1))
    normals = np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (len(corners), 1))
    return Mesh(corners, normals, corners[:, :2].copy(), np.concatenate([faces, fill]))


def build_scene(body: Body, max_boxes: int, slots: int, size: int, preset: WorldPreset) -> RenderScene:
    """Compile the model that draws `slots` worlds in frames of up to `size` pixels."""
    spec = mujoco.MjSpec.from_string(_mjcf(body, max_boxes, size, preset))
    atlas = Atlas(preset.drawn_wall_height)
    blank = _blank_mesh()
    for slot in range(slots):
        _add_mesh(spec, f"level{slot}", blank, atlas.shape)
    _add_mesh(spec, "skyline", skyline_mesh(body.cell_size), SKYLINE_SHAPE)
    if preset.box_chamfer:
        spec.add_mesh(name="box", uservert=box_vertices(body.cell_size, preset.box_chamfer).ravel().tolist())
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
        if not geom.name.startswith("box"):
            continue
        if preset.box_chamfer:
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, "box"
        else:
            geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, body.cell_size * np.array(BOX_HALF_EXTENT)
    for name, mesh in (("static", "level0"), ("skyline", "skyline")):
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, material=mesh, contype=0, conaffinity=0
        )
    model = spec.compile()
    scene = RenderScene(
        model,
        model.geom("static").id,
        model.geom("skyline").id,
        np.array([model.geom(f"box{i}").id for i in range(max_boxes)], np.int64),
        np.array([model.geom(f"target{i}").id for i in range(max_boxes)], np.int64),
        body.cell_size,
        atlas,
    )
    # What moves at run time has to be drawn at its own frame, not at the one that compilation found.
    model.geom_sameframe[[scene.static_geom, scene.skyline_geom, *scene.target_geoms]] = 0
    for geom in (scene.static_geom, scene.skyline_geom):
        model.geom_pos[geom] = 0.0
        model.geom_quat[geom] = (1.0, 0.0, 0.0, 0.0)
    _write_mesh(model, model.mesh("skyline").id, skyline_mesh(body.cell_size))
    _write_texture(model, model.texture("skyline").id, draw_skyline())
    model.geom_group[_unseen_robot_geoms(model, body)] = UNSEEN_GROUP
    return scene


def _unseen_robot_geoms(model: mujoco.MjModel, body: Body) -> NDArray[np.int64]:
    """Return the robot's geoms that its own camera never sees; only a body that cannot bend has some."""
    if body.root != "slides":
        return np.zeros(0, np.int64)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    robot = model.body(ROBOT_BODY).id
    geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == robot)
    seen = in_view(data.geom_xpos[geoms], model.geom_rbound[geoms], np.zeros(3), body.camera)
    return geoms[~seen]


def write_level(scene: RenderScene, slot: int, wall: NDArray[np.bool_], seed: int) -> None:
    """Write a level's static part and an episode's textures into a slot; they still have to be uploaded.

    Args:
        scene: the scene to write to.
        slot: number of the slot, which is also the index of its mesh, texture and material.
        wall: wall cells, [N, N].
        seed: the episode's seed.
    """
    atlas = scene.atlas
    _write_mesh(scene.model, slot, level_mesh(wall, scene.cell_size, atlas.wall_height, atlas.band_range))
    _write_texture(scene.model, slot, atlas.draw(seed))


def _write_mesh(model: mujoco.MjModel, index: int, mesh: Mesh) -> None:
    """Overwrite a mesh of the model by one that is no larger."""
    count, faces = len(mesh.vertices), len(mesh.faces)
    vertex, normal = model.mesh_vertadr[index], model.mesh_normaladr[index]
    texcoord, face = model.mesh_texcoordadr[index], model.mesh_faceadr[index]
    model.mesh_vert[vertex : vertex + count] = mesh.vertices
    model.mesh_normal[normal : normal + count] = mesh.normals
    model.mesh_texcoord[texcoord : texcoord + count] = mesh.texcoords
    for indices in (model.mesh_face, model.mesh_facenormal, model.mesh_facetexcoord):
        indices[face : face + faces] = mesh.faces
    model.mesh_facenum[index] = faces


def _write_texture(model: mujoco.MjModel, index: int, image: NDArray[np.uint8]) -> None:
    """Overwrite a texture of the model by an image of the same shape."""
    start = model.tex_adr[index]
    model.tex_data[start : start + image.size] = image.ravel()
