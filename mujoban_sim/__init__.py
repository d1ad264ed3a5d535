"""The physical world: scene, physics, rendering, oracles, Gymnasium environments, simulator node."""

import importlib
import os
from typing import Final

from gymnasium.envs.registration import register

BACKENDS: Final = ("egl", "osmesa", "glfw")
"""What the variable MUJOCO_GL may name here."""


def _import_mujoco() -> None:
    """Import MuJoCo where MUJOCO_GL names what it does not know, as that ends the import with a traceback.

    Only who draws needs the variable, and is told in one line then (`rendering.open_context`).
    """
    named = os.environ.pop("MUJOCO_GL")
    try:
        importlib.import_module("mujoco")
    finally:
        os.environ["MUJOCO_GL"] = named


if os.environ.get("MUJOCO_GL", "").strip().lower() not in ("", *BACKENDS):
    _import_mujoco()

register(
    "Mujoban-v0",
    entry_point="mujoban_sim.env:MujobanEnv",
    vector_entry_point="mujoban_sim.vector_env:MujobanVectorEnv",
)
