"""The physical world: scene, physics, rendering, oracles, Gymnasium environments, simulator node."""

from gymnasium.envs.registration import register

register(
    "Mujoban-v0",
    entry_point="mujoban_sim.env:MujobanEnv",
    vector_entry_point="mujoban_sim.vector_env:MujobanVectorEnv",
)
