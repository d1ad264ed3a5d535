"""Many Mujoban environments that step together: the vectorised ``Mujoban-v0``."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mujoban_core.grid import DIFFICULTIES
from mujoban_sim.env import (
    RENDER_SIZE,
    MujobanEnv,
    Observations,
    ObservationSet,
    check_observation_set,
    check_open,
    check_options,
    check_render_mode,
    draw_seed,
    observation_space,
)
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.sights import observe
from mujoban_sim.world import World
from mujoban_sokoban.episodes import LevelSource


class MujobanVectorEnv(VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """B Mujoban environments in one batched world; see `MujobanEnv` for spaces, rewards and episode ends.

    Environment i behaves exactly as a single `MujobanEnv` that gets the same seeds and actions. All three
    autoreset modes of Gymnasium work as documented there: ``NEXT_STEP`` (default), ``SAME_STEP`` (with
    ``final_obs`` and ``final_info``) and ``DISABLED`` (``reset(options={"reset_mask": mask})``).
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        difficulty: int = max(DIFFICULTIES),
        level_file: str | PathLike[str] | None = None,
        observations: ObservationSet = "default",
        body: str = "ball",
        world: str = DEFAULT_WORLD,
        time_limit: int | None = None,
        render_mode: str | None = None,
        threads: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        """Make the environments.

        Args:
            num_envs: B.
            difficulty: and all arguments up to `render_mode` as of `MujobanEnv`.
            level_file: see there.
            observations: see there.
            body: see there.
            world: see there.
            time_limit: see there.
            render_mode: see there.
            threads: threads for physics and for drawing; the results do not depend on it.
            autoreset_mode: what happens when an episode ends.

        Raises:
            ValueError: if an argument is out of its range or the level file is malformed.
        """
        self.metadata = {**MujobanEnv.metadata, "autoreset_mode": AutoresetMode(autoreset_mode)}
        check_render_mode(render_mode)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._source = LevelSource.make(difficulty, level_file)
        self._names = check_observation_set(observations)
        self.world = World(
            num_envs,
            body=body,
            world=world,
            max_boxes=self._source.max_boxes,
            time_limit=time_limit,
            threads=threads,
        )
        self.single_observation_space = observation_space(self._names, self.world.body, self.world.max_boxes)
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.world.body.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start episodes in all environments, or where ``options["reset_mask"]``.

        Args:
            seed: one per environment; an integer s stands for s, s + 1, ...
            options: ``reset_mask``: bool [B], at least one of them true.

        Raises:
            ValueError: if an option is unknown, the number of seeds or the mask's shape is wrong, or nothing is to be
                reset.
        """
        check_open(self.closed)
        check_options(options, "reset_mask")
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(f"reset_mask {mask!r}: expected {self.num_envs} booleans, one of them true at least")
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds: expected one for each of {self.num_envs} environments")
        infos = self._restart(np.flatnonzero(mask), seeds)
        return observe(self.world, self._names), infos

    def _restart(self, rows: NDArray[np.int64], seeds: Sequence[int | None]) -> dict[str, Any]:
        episodes, infos = [], {}
        for row in rows.tolist():
            seed = seeds[row]
            if seed is not None:
                # As `gymnasium.Env.reset` does, so that later draws are those of a single environment.
                self._generators[row] = seeding.np_random(seed)[0]
            chosen = draw_seed(self._generators[row]) if seed is None else seed
            episodes.append(self._source.episode(chosen))
            infos = self._add_info(infos, {"seed": chosen, "level": episodes[-1].level.to_text()}, row)
        self.world.reset(rows, episodes)
        self._ended[rows] = False
        return infos

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observations, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply torques, [B, U], for 50 ms.

        Raises:
            TorqueError: if they are malformed; nothing has moved then.
            RuntimeError: if an episode has ended and, with autoreset disabled, has not been reset.
        """
        check_open(self.closed)
        world, mode = self.world, self.metadata["autoreset_mode"]
        if mode == AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(f"environments {np.flatnonzero(self._ended).tolist()} have ended: reset them first")
        world.step(np.asarray(actions))
        rewards = world.reward.astype(np.float64)
        infos: dict[str, Any] = {}
        restarted = self._ended.copy()
        if restarted.any():
            # The rows that ended in the step before ignore their action and start anew, without reward.
            infos = self._restart(np.flatnonzero(restarted), [None] * self.num_envs)
        terminations, truncations = world.solved.copy(), world.truncated.copy()
        self._ended = terminations | truncations
        if mode == AutoresetMode.SAME_STEP and self._ended.any():
            restarted = self._ended.copy()
            infos = self._final()
            infos |= self._restart(np.flatnonzero(restarted), [None] * self.num_envs)
        return observe(world, self._names), rewards, terminations, truncations, infos | self._outcomes(~restarted)

    def _outcomes(self, stepped: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the infos of a step, of the rows that took one; others have those of a reset."""
        on_target = np.where(stepped, self.world.boxes_on_target, 0)
        return {
            "solved": self.world.solved & stepped, "_solved": stepped,
            "boxes_on_target": on_target, "_boxes_on_target": stepped.copy(),
        }  # fmt: skip

    def _final(self) -> dict[str, Any]:
        """Return the last observations and infos of the episodes that have just ended."""
        observations = observe(self.world, self._names)
        final: dict[str, Any] = {}
        for row in np.flatnonzero(self._ended).tolist():
            last = {name: values[row].copy() for name, values in observations.items()}
            info = {"solved": self.world.solved[row], "boxes_on_target": self.world.boxes_on_target[row]}
            final = self._add_info(final, {"final_obs": last, "final_info": info}, row)
        return final

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a view from above for each environment if the render mode is ``"rgb_array"``."""
        check_open(self.closed)
        if self.render_mode is None:
            return None
        return tuple(self.world.render("top_down", size=RENDER_SIZE))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the cameras."""
        self.world.close()
