"""The robot's bodies by name; a body is a file with a `Body`, entered in `BODIES` (docs/adding_a_body.md)."""

from __future__ import annotations

from typing import Final

from mujoban_core.bodies.ant import ANT
from mujoban_core.bodies.ball import BALL
from mujoban_core.bodies.body import (
    FIRST_PERSON_CAMERA,
    INERTIAL_SIZE,
    ROBOT_BODY,
    ROBOT_DEFAULTS,
    UP_AXIS_SIZE,
    Actuator,
    Body,
    Motor,
    ProprioSlices,
    Relabelling,
    RobotPhysics,
    Servo,
)

__all__ = [
    "ANT", "BALL", "BODIES", "FIRST_PERSON_CAMERA", "INERTIAL_SIZE", "ROBOT_BODY", "ROBOT_DEFAULTS", "UP_AXIS_SIZE",
    "Actuator", "Body", "Motor", "ProprioSlices", "Relabelling", "RobotPhysics", "Servo", "get_body",
]  # fmt: skip

BODIES: Final[dict[str, Body]] = {body.name: body for body in (BALL, ANT)}
"""Registry of bodies; add one and every environment, node and trainer accepts its name."""


def get_body(name: str) -> Body:
    """Return the body of a given name.

    Raises:
        ValueError: if there is none.
    """
    try:
        return BODIES[name]
    except KeyError:
        raise ValueError(f"unknown body {name!r}: expected one of {', '.join(sorted(BODIES))}") from None
