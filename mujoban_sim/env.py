"""The Gymnasium environment ``Mujoban-v0``: one robot, one level at a time."""

from __future__ import annotations

from os import PathLike
from typing import Any, Final, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import CHANNELS, CONTROL_PERIOD, DIFFICULTIES, GRID_SIZE
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.sights import observe
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec, LevelSource
from mujoban_sokoban.generator import draw_training_seeds
from mujoban_sokoban.levels import Level

Observations = dict[str, Any]
"""Arrays by name."""
ObservationSet = Literal["default", "state", "privileged"]
_RENDER_MODES: Final = ("rgb_array",)

OBSERVATION_SETS: Final[dict[str, tuple[str, ...]]] = {
    "default": ("frame", "proprio", "pose"),
    "state": ("proprio", "pose", "velocity", "box_position", "abstract_state"),
    "privileged": ("frame", "top_down", "proprio", "pose", "velocity", "box_position", "abstract_state"),
}
"""What is observed: as the robot perceives (paper appendix B), all but cameras, or everything."""
RENDER_SIZE: Final = 256
"""Rows and columns of what `render` returns."""


def observation_space(names: tuple[str, ...], body: Body, max_boxes: int) -> spaces.Dict:
    """Return the space of one robot's observations of the given names."""

    def image() -> spaces.Box:
        return spaces.Box(0, 255, (FRAME_SIZE, FRAME_SIZE, 3), np.uint8)

    def real(*shape: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, shape, np.float32)

    known = {
        "frame": image(),
        "top_down": image(),
        "proprio": real(body.proprio_size),
        "pose": real(3),
        "velocity": real(3),
        "box_position": real(max_boxes, 2),
        "abstract_state": spaces.Box(0.0, 1.0, (GRID_SIZE, GRID_SIZE, len(CHANNELS)), np.float32),
    }
    return spaces.Dict({name: known[name] for name in names})


def draw_seed(generator: np.random.Generator) -> int:
    """Return the seed of an episode for which the user gave none; never one of the test levels'."""
    return draw_training_seeds(generator, 1)[0]


def check_render_mode(name: str | None) -> None:
    """Raise `ValueError` unless `render` knows a mode."""
    if name is not None and name not in _RENDER_MODES:
        raise ValueError(f"unknown render_mode {name!r}: expected None or {' or '.join(map(repr, _RENDER_MODES))}")


def check_observation_set(name: str) -> tuple[str, ...]:
    """Return the names of the observations in a set.

    Raises:
        ValueError: if there is no such set.
    """
    if name not in OBSERVATION_SETS:
        raise ValueError(f"unknown observation set {name!r}: expected one of {', '.join(OBSERVATION_SETS)}")
    return OBSERVATION_SETS[name]


def check_open(closed: bool) -> None:
    """Raise an error if an environment has been closed."""
    if closed:
        raise ClosedEnvironmentError("the environment is closed: make a new one with gymnasium.make")


def check_options(options: dict[str, Any] | None, known: str) -> None:
    """Raise `ValueError` if a reset has options but the one that it knows."""
    unknown = sorted((options or {}).keys() - {known})
    if unknown:
        raise ValueError(f"unknown options {', '.join(unknown)}: expected {known} or none")


class MujobanEnv(gymnasium.Env[Observations, NDArray[np.float32]]):
    """Sokoban in a physical 3D warehouse, seen through the robot's own camera.

    ## Description
    A robot pushes boxes onto target pads in a walled grid of up to 10 x 10 cells of 1 m (Karkus et al., 2020,
    appendix B). It can push but not pull, pegs at the grid's corners keep boxes in lanes, and a box in a corner
    stays there. Colours and textures are drawn anew for every episode; the skyline around stays the same.

    ## Action space
    ``Box(-1, 1, (U,), float32)``: normalised controls of the body's actuators, held for 50 ms (20 Hz). The ball has
    U = 2 motors, the ant 8 servos, hip and ankle of one leg after the other, counter-clockwise from the front left:

    | body | index | joint | 1.0 means |
    |---|---|---|---|
    | ball | 0 | roll: drives the ball forwards (+) or backwards | 20 N m |
    | ball | 1 | steer: turns the robot to its left (+) or right | 20 N m |
    | ant | 0, 2, 4, 6 | hip: swings the leg to the robot's left (+) or right | towards 35 degrees, at most 40 N m |
    | ant | 1, 3, 5, 7 | ankle: bends the shin down (+) or up | towards 75 degrees; -1.0: towards 25 |

    A torque that is NaN or outside [-1, 1] raises `mujoban_sim.checks.TorqueError`; wrap the environment in
    ``gymnasium.wrappers.ClipAction`` for policies without bounds.

    ## Observation space
    A ``Dict`` with the keys of the observation set. Units are metres, radians and seconds, in the frame ``map``: x
    east, y north, its origin at the centre of the padded grid, yaw counter-clockwise from east.

    | key | space | meaning | sets |
    |---|---|---|---|
    | ``frame`` | uint8 (64, 64, 3) | first-person camera, RGB | default, privileged |
    | ``proprio`` | float32 (P,) | proprioception, see `mujoban_core.bodies.ProprioSlices`; P = 16 (ant: 28) | all |
    | ``pose`` | float32 (3,) | x, y, yaw of the robot | all |
    | ``velocity`` | float32 (3,) | vx, vy, yaw rate in the frame ``map`` | state, privileged |
    | ``box_position`` | float32 (K, 2) | box centres; absent boxes lie 100 cells away and more | state, privileged |
    | ``abstract_state`` | float32 (10, 10, 4) | walls, targets, agent, boxes by cell, row 0 north | state, privileged |
    | ``top_down`` | uint8 (64, 64, 3) | camera above the grid, RGB, north up | privileged |

    ## Rewards
    +1 for a box pushed onto a target pad, -1 for one pushed off, +10 for solving the level. A box is on a pad when at
    least half of it, in both axes, lies within.

    ## Starting state
    Robot and boxes stand at the centres of their cells; the robot's heading is uniform. ``reset(seed=s)`` plays
    episode s: the level generated from s (or number s modulo the count of a level file), with the heading and the
    appearance of s. ``reset()`` draws a seed, never one of those below 10,000,000 for validation and tests.
    ``reset(options={"level": level})`` plays a given `mujoban_sokoban.levels.Level`, or a level text.

    ## Episode end
    - ``terminated``: every box is on a target at once.
    - ``truncated``: the time limit (4,800 steps, 240 s; twice that for the ant, whose cells are 3 m wide).

    ## Info
    ``reset``: ``seed``, and ``level`` as a text. ``step``: ``solved`` and ``boxes_on_target``.

    ## Rendering
    ``render_mode="rgb_array"``: `render` returns a view from above, uint8 (256, 256, 3); Gymnasium makes
    ``"rgb_array_list"`` of it, and with pygame installed ``"human"``, a window. The robot's own view is ``frame``.

    ## Arguments
    ``gymnasium.make("Mujoban-v0", difficulty=5, level_file=None, observations="default", body="ball",
    world=DEFAULT_WORLD, time_limit=None, render_mode=None)``. `import mujoban_sim` registers the environment.

    ## Version history
    v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": list(_RENDER_MODES),
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        *,
        difficulty: int = max(DIFFICULTIES),
        level_file: str | PathLike[str] | None = None,
        observations: ObservationSet = "default",
        body: str = "ball",
        world: str = DEFAULT_WORLD,
        time_limit: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment.

        Args:
            difficulty: 1 to 5, of generated levels (paper Table 3).
            level_file: levels in the Boxoban format, instead of generated ones.
            observations: observation set: ``"default"``, ``"state"`` (no cameras) or ``"privileged"``.
            body: the robot's body.
            world: the physical world: ``"reference"`` or ``"eased"`` (`mujoban_sim.presets`).
            time_limit: steps of an episode; None: the body's.
            render_mode: None or ``"rgb_array"``: `render` returns a view from above.

        Raises:
            ValueError: if an argument is out of its range or the level file is malformed.
        """
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self._closed = False
        self._source = LevelSource.make(difficulty, level_file)
        self._names = check_observation_set(observations)
        self.world = World(
            1, body=body, world=world, max_boxes=self._source.max_boxes, time_limit=time_limit
        )
        self.observation_space = observation_space(self._names, self.world.body, self.world.max_boxes)
        self.action_space = spaces.Box(-1.0, 1.0, (self.world.body.action_size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; see the class for what `seed` and `options` do.

        Raises:
            ClosedEnvironmentError: after `close`, as of `step` and `render`.
            ValueError: if an option is unknown or the level malformed.
        """
        check_open(self._closed)
        check_options(options, "level")
        super().reset(seed=seed)
        chosen = draw_seed(self.np_random) if seed is None else seed
        level = (options or {}).get("level")
        if isinstance(level, str):
            level = Level.from_text(level)
        if not isinstance(level, Level | None):
            raise ValueError(f"level is a {type(level).__name__}: expected a Level or a level text")
        episode = self._source.episode(chosen) if level is None else EpisodeSpec(level, chosen)
        self.world.reset([0], [episode])
        return self._observe(), {"seed": chosen, "level": episode.level.to_text()}

    def step(self, action: NDArray[np.float32]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Apply torques, [U], for 50 ms.

        Raises:
            TorqueError: if they are malformed; nothing has moved then.
        """
        check_open(self._closed)
        world = self.world
        world.step(np.asarray(action)[None])
        solved = bool(world.solved[0])
        info = {"solved": solved, "boxes_on_target": int(world.boxes_on_target[0])}
        return self._observe(), float(world.reward[0]), solved, bool(world.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a view from above, uint8 [256, 256, 3], if the render mode is ``"rgb_array"``."""
        check_open(self._closed)
        if self.render_mode is None:
            return None
        return self.world.render("top_down", size=RENDER_SIZE)[0]

    def close(self) -> None:
        """Free the cameras; nothing but `close` may be called after."""
        self._closed = True
        self.world.close()

    def _observe(self) -> Observations:
        return {name: values[0] for name, values in observe(self.world, self._names).items()}
