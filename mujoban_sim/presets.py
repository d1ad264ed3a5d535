"""The physical figures of the worlds that can be played, by name: ``reference`` and ``eased``.

``reference`` is the public environment that the paper's authors released, as far as its measured runs tell
(``python -m benchmarks.conformance``); ``eased`` has lower drawn walls, boxes with cut edges and slippery sides, and a
lighter head. What all worlds have in common stands in `mujoban_sim.scene` and `mujoban_core.bodies`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from mujoban_core.bodies import RobotPhysics
from mujoban_core.grid import CONTROL_PERIOD


@dataclass(frozen=True)
class WorldPreset:
    """What differs between worlds. Lengths in cells are scaled with the body's cell.

    Attributes:
        name: key in `WORLDS`.
        drawn_wall_height: height of drawn walls in cells; physical walls are always `mujoban_sim.scene.WALL_HEIGHT`.
        substeps: physics steps of one control step.
        cone: friction cones of the contact solver.
        noslip_iterations: sweeps that take the creep out of friction after each solve. Without them a contact that
            sticks still slides slowly under load, and a robot that steers below the friction of its ball turns.
        friction: sliding friction of walls, pegs and floor.
        box_friction: sliding friction of boxes with all but the floor.
        box_friction_prevails: whether `box_friction` alone counts; else the larger one of the two that touch.
        box_chamfer: how much of a box's vertical edges is cut off, in cells.
        robot: figures of the robot.
    """

    name: str
    drawn_wall_height: float
    substeps: int
    cone: Literal["elliptic", "pyramidal"]
    noslip_iterations: int
    friction: float
    box_friction: float
    box_friction_prevails: bool
    box_chamfer: float
    robot: RobotPhysics

    @property
    def physics_step(self) -> float:
        """Seconds of one physics step."""
        return CONTROL_PERIOD / self.substeps


REFERENCE: Final = WorldPreset(
    name="reference",
    drawn_wall_height=1.0,
    # 5 steps leave the bounds of the recorded runs, 8 are as near to them as the reference's own 10.
    substeps=8,
    cone="elliptic",
    noslip_iterations=1,
    friction=1.0,
    box_friction=1.0,
    box_friction_prevails=False,
    box_chamfer=0.0,
    # Total mass and inertia follow from the recorded runs: friction of steering and the time it takes.
    robot=RobotPhysics(head_mass=21.0, head_inertia=(1.17, 1.17, 1.17), friction=(0.5, 0.02, 0.02)),
)

EASED: Final = WorldPreset(
    name="eased",
    # Below the camera, so that wall tops and, from afar, what lies behind show.
    drawn_wall_height=0.5,
    substeps=5,
    cone="pyramidal",
    noslip_iterations=0,
    friction=0.5,
    # With more, a robot that bends its way drags the box aside.
    box_friction=0.1,
    box_friction_prevails=True,
    # A box slides between the next pegs, and back into its lane, from 0.12 cells off it instead of 0.1. With more,
    # the pegs let go of a box too early in a push.
    box_chamfer=0.03,
    robot=RobotPhysics(head_mass=20.0, head_inertia=(0.11, 0.11, 0.147), friction=(0.5, 0.005, 0.0001)),
)

WORLDS: Final[dict[str, WorldPreset]] = {preset.name: preset for preset in (REFERENCE, EASED)}
"""The worlds by name."""

DEFAULT_WORLD: Final = REFERENCE.name
"""The world that is played where none is named; all weights that ship are of it."""


def get_world(name: str) -> WorldPreset:
    """Return the world of a given name.

    Raises:
        ValueError: if there is none.
    """
    try:
        return WORLDS[name]
    except KeyError:
        raise ValueError(f"unknown world {name!r}: expected one of {', '.join(WORLDS)}") from None
