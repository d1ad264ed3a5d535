"""The scripted driver of the ball: it knows where everything is. A baseline, from which no shipped weight learns.

It differs from the oracle of `mujoban_sim.oracles` where a student needs it to. It bends back to its lane smoothly
instead of turning round at a distance from it: a student that is not sure on which side of such a threshold it is
cannot imitate what flips there. It never stops short of its goal, since a student that does, by mistake, would
stand there for good.

Shapes: B robots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.goal_features import goal_offsets
from mujoban_controller.goal_task import GoalTask
from mujoban_core.grid import OFFSETS_XY
from mujoban_sim.driving import SteeringGains, limit_speed, plot_course, push_speed, roll_and_steer, touches
from mujoban_sim.goals import GoalKind


@dataclass(frozen=True)
class TeacherGains(SteeringGains):
    """Gains of the scripted driver; lengths in cells, speeds in cells per second, angles in radians.

    It creeps on with `least_speed` until the termination signal comes.
    """

    speed: float = 1.5
    move_braking: float = 3.3
    """Speed per cell that is left of a move, or of the way back to a lane or centre."""
    lane_tolerance: float = 0.3
    move_lane_gain: float = 1.5
    """Weight of the distance from the lane in the direction to drive in."""
    push_lane_gain: float = 2.5
    """The same for pushes. There are 0.3 cells until it touches the box: if it still bends to its lane then, friction
    drags the box across, and the box may come to rest between the next pegs, out of tolerance for good."""
    look_ahead: float = 0.5
    hold_radius: float = 0.06
    """Distance from the centre within which it stands still when it is to hold."""
    overshot: float = 0.1
    """Distance past the goal of a move beyond which it comes back."""


GAINS = TeacherGains()


def scripted_driver(task: GoalTask) -> NDArray[np.float32]:
    """Return the scripted driver's torques (roll, steer) in a task, [B, 2]."""
    world, goals, g = task.world, task.world.goals, GAINS
    offsets = goal_offsets(world).astype(np.float64)
    to_target = offsets[:, :2]
    push = goals.kind == GoalKind.PUSH
    # A move whose goal lies behind is over: what is left is to hold that cell.
    move = (goals.kind == GoalKind.MOVE) & (to_target[:, 0] >= -g.overshot)
    lane = OFFSETS_XY[goals.direction] * (push | move)[:, None]
    lane_gain = np.where(push, g.push_lane_gain, g.move_lane_gain)[:, None]
    course = plot_course(goals.robot_target, world.pose, lane, lane_gain, g, world.body.cell_size)
    left = np.where(course.recentre, course.off_lane, course.along)
    pushing = push & ~course.recentre
    wanted = np.where(pushing, push_speed(offsets[:, 2], task.forward_speed, g), g.move_braking * left)
    speed = limit_speed(wanted, g.speed, course, g)
    box = world.box_position[np.arange(world.batch), goals.box_index]
    pushing &= touches(world.pose, box, lane, g, world.body.cell_size)
    # The course to a centre that is reached already is noise, which a student could only learn as such.
    holding = ~(push | move) & (np.linalg.norm(to_target, axis=1) < g.hold_radius)
    speed, error = np.where(holding, 0.0, speed), np.where(holding, 0.0, course.error)
    return roll_and_steer(speed, error, pushing, task.forward_speed, world.velocity[:, 2], g)
