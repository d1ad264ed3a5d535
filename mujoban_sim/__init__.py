"""The physical world: scene, physics, rendering, oracles, Gymnasium environments, simulator node."""

import os
from typing import Final

from gymnasium.envs.registration import register

from mujoban_core.imports import import_without

BACKENDS: Final = ("egl", "osmesa", "glfw")
"""What the variable MUJOCO_GL may name here."""

# Another name would end MuJoCo's import with a traceback. Only who draws needs one, and is told in one line then.
if os.environ.get("MUJOCO_GL", "").strip().lower() not in ("", *BACKENDS):
    import_without("MUJOCO_GL", "mujoco")

register(
    "Mujoban-v0",
    entry_point="mujoban_sim.env:MujobanEnv",
    vector_entry_point="mujoban_sim.vector_env:MujobanVectorEnv",
)
