"""The geometry of scripted driving, which oracle and teacher share: lane, course, speed and torques of the ball.

The lane of an instruction is the line through its goal in its direction. A driver that is off its lane, or has none,
recentres first, backwards if that is nearer.

Shapes: B robots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class SteeringGains:
    """What scripted drivers have in common; lengths in cells, speeds in cells per second, angles in radians."""

    least_speed: float = 0.15
    """Speed to which the robot slows down at its goal."""
    lane_tolerance: float = 0.12
    """Distance from the lane beyond which the robot recentres before it drives on."""
    look_ahead: float = 0.4
    turn_limit: float = 0.5
    """Heading error above which the robot turns on the spot."""
    roll_feed_forward: float = 0.5
    roll_gain: float = 2.0
    """High enough that the box of a slippery world, which needs less torque, is not pushed too fast."""
    steer_gain: float = 3.0
    steer_damping: float = 0.15
    push_torque: float = 0.4
    """Torque that most of friction takes while the ball pushes a box as rough as itself: without it a push stalls
    short of its goal, and a box that rests 0.06 cells off does not get between the pegs of its next lane."""
    push_reach: float = 0.64
    """Distance between the centres of robot and box within which they touch."""
    push_speed: float = 1.2
    push_deceleration: float = 2.0
    """Deceleration towards a push's end, in cells per s^2. Friction stops a box with 4.9: it never leaves the robot."""
    push_braking: float = 20.0
    """Speed per cell that is left of a push, close to its end."""
    push_lag: float = 0.08
    """Seconds by which a push brakes earlier than that: the wheel's lag."""


class Course(NamedTuple):
    """Where robots are to go."""

    along: NDArray[np.float64]
    """Cells to the goal along the lane, [B]."""
    off_lane: NDArray[np.float64]
    """Cells to the lane, or to the goal where there is none, [B]."""
    recentre: NDArray[np.bool_]
    """Where the robot goes to its lane, or to its goal, before anything else, [B]."""
    error: NDArray[np.floating]
    """Angle by which to turn, [B]."""
    backwards: NDArray[np.bool_]
    """Where the robot drives backwards, [B]."""


def plot_course(
    target: NDArray[np.float64],
    pose: NDArray[np.floating],
    lane: NDArray[np.float64],
    lane_gain: ArrayLike,
    gains: SteeringGains,
    cell_size: float,
) -> Course:
    """Return the course to targets.

    Args:
        target: Positions in the map frame [m], [B, 2].
        pose: (x [m], y [m], psi [rad]) of the robots, [B, 3].
        lane: Unit vectors along the lanes, zero where a robot is to hold its cell, [B, 2].
        lane_gain: Weight of the distance from the lane in the direction to drive in, a number or [B, 1].
        gains: The driver's gains.
        cell_size: Edge of a cell [m].
    """
    to_goal = (target - pose[:, :2]) / cell_size
    along = (to_goal * lane).sum(-1)
    aside = to_goal - along[:, None] * lane
    off_lane = np.linalg.norm(aside, axis=-1)
    recentre = ~lane.any(-1) | (off_lane > gains.lane_tolerance)
    bend = np.where(recentre[:, None], aside, aside * lane_gain + lane * gains.look_ahead)
    error = wrap_angles(np.arctan2(bend[:, 1], bend[:, 0]) - pose[:, 2])
    backwards = recentre & (np.abs(error) > np.pi / 2)
    return Course(along, off_lane, recentre, np.where(backwards, wrap_angles(error + np.pi), error), backwards)


def limit_speed(
    wanted: NDArray[np.floating], most: ArrayLike, course: Course, gains: SteeringGains
) -> NDArray[np.floating]:
    """Return the signed speed at which to go, [B]: the less, the more there is to turn.

    Args:
        wanted: Speed before any limit, [B].
        most: Largest speed, a number or [B].
        course: The course.
        gains: The driver's gains.
    """
    speed = np.clip(wanted, gains.least_speed, most)
    speed *= np.clip(np.cos(course.error), 0.0, 1.0) ** 4 * (np.abs(course.error) <= gains.turn_limit)
    return np.where(course.backwards, -speed, speed)


def push_speed(
    box_left: NDArray[np.floating], forward_speed: NDArray[np.floating], gains: SteeringGains
) -> NDArray[np.floating]:
    """Return the speed at which to push boxes that have `box_left` cells to go, [B]."""
    left = np.maximum(box_left - gains.push_lag * np.maximum(forward_speed, 0.0), 0.0)
    speed = np.minimum(np.sqrt(2.0 * gains.push_deceleration * left), gains.push_braking * left)
    return np.minimum(speed, gains.push_speed)


def roll_and_steer(
    speed: NDArray[np.floating],
    error: NDArray[np.floating],
    pushing: NDArray[np.bool_],
    forward_speed: NDArray[np.floating],
    yaw_rate: NDArray[np.floating],
    gains: SteeringGains,
) -> NDArray[np.float32]:
    """Return the torques (roll, steer) of the ball, normalised, [B, 2].

    Args:
        speed: Wanted, [B].
        error: Angle by which to turn, [B].
        pushing: Where a box is before the robot and is to be pushed, [B].
        forward_speed: As it is, [B].
        yaw_rate: As it is [rad/s], [B].
        gains: The driver's gains.
    """
    roll = gains.roll_feed_forward * speed + gains.roll_gain * (speed - forward_speed)
    roll = roll + gains.push_torque * (pushing & (speed > 0.0))
    steer = gains.steer_gain * error - gains.steer_damping * yaw_rate
    return np.clip(np.stack([roll, steer], -1), -1.0, 1.0).astype(np.float32)


def forward_speed(
    pose: NDArray[np.floating], velocity: NDArray[np.floating], cell_size: float
) -> NDArray[np.floating]:
    """Return the speed along the heading in cells per second, [B].

    Args:
        pose: (x [m], y [m], psi [rad]), [B, 3].
        velocity: (vx [m/s], vy [m/s], yaw rate [rad/s]) in the map frame, [B, 3].
        cell_size: Edge of a cell [m].
    """
    heading = pose[:, 2]
    return (velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)) / cell_size


def touches(
    pose: NDArray[np.floating],
    box: NDArray[np.floating],
    lane: NDArray[np.float64],
    gains: SteeringGains,
    cell_size: float,
) -> NDArray[np.bool_]:
    """Return whether robots have come up to boxes along their lanes, [B].

    Args:
        pose: (x [m], y [m], psi [rad]), [B, 3].
        box: Centres in the map frame [m], [B, 2].
        lane: Unit vectors along the lanes, [B, 2].
        gains: The driver's gains.
        cell_size: Edge of a cell [m].
    """
    return ((box - pose[:, :2]) * lane).sum(-1) < gains.push_reach * cell_size


def wrap_angles(angle: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
