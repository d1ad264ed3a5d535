"""What goal features and rewards are made of: a `World` as it is, or what was stored of one.

Shapes: B robots, M of their rows, K boxes, P proprioceptive values, N rows and columns of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import Body
from mujoban_sim.goals import GoalTracker


class GoalView(Protocol):
    """Where robots, boxes and walls are, and the instructions in force; as in `mujoban_sim.world.World`."""

    batch: int
    body: Body
    goals: GoalTracker
    wall: NDArray[np.bool_]
    proprio: NDArray[np.float32]
    pose: NDArray[np.float32]
    velocity: NDArray[np.float32]
    box_position: NDArray[np.float32]
    box_speed: NDArray[np.float32]
    box_cell: NDArray[np.int64]


@dataclass
class StoredView:
    """What was stored of worlds, or of one at B ticks."""

    body: Body
    batch: int
    goals: GoalTracker
    proprio: NDArray[np.float32]
    pose: NDArray[np.float32]
    velocity: NDArray[np.float32]
    box_position: NDArray[np.float32]
    box_speed: NDArray[np.float32]
    box_cell: NDArray[np.int64]
    wall: NDArray[np.bool_]

    def at(self, rows: NDArray[np.int64], goals_of: NDArray[np.int64]) -> StoredView:
        """Return the given rows with the goals of others, [M] each."""
        goals = GoalTracker(len(rows), cell_size=self.body.cell_size)
        goals.restore([m[goals_of] for m in self.goals.memory()])
        return StoredView(
            self.body, len(rows), goals, self.proprio[rows], self.pose[rows], self.velocity[rows],
            self.box_position[rows], self.box_speed[rows], self.box_cell[rows], self.wall[rows],
        )  # fmt: skip


