"""What `World` asks of its arguments, and the errors that name what is wrong with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import GRID_SIZE, xy_to_cell
from mujoban_sim.world_kernels import apply_torque


class TorqueError(ValueError):
    """A torque has the wrong shape, is not finite or lies outside [-1, 1]; the world has not moved."""


def check_rows(rows: ArrayLike, batch: int) -> NDArray[np.int64]:
    """Return rows as an array, [M].

    Raises:
        ValueError: if one is out of range or appears twice.
    """
    chosen = np.atleast_1d(np.asarray(rows, np.int64))
    if chosen.size and (chosen.min() < 0 or chosen.max() >= batch):
        raise ValueError(f"rows {chosen.tolist()}: expected 0 to {batch - 1}")
    if len(set(chosen.tolist())) != len(chosen):
        raise ValueError(f"rows {chosen.tolist()}: expected each once")
    return chosen


def check_places(
    pose: NDArray[np.float64], box_position: NDArray[np.float64], present: NDArray[np.bool_], cell_size: float
) -> None:
    """Reject places of robots and boxes that are not on the grid.

    Args:
        pose: (x [m], y [m], psi [rad]) of the robots, [M, 3].
        box_position: [M, K, 2] in metres.
        present: which boxes there are, [M, K]; others lie anywhere.
        cell_size: edge of a cell [m].

    Raises:
        ValueError: if a shape is wrong, a number is not finite or a cell is not of the grid.
    """
    expected = (len(present), 3), (*present.shape, 2)
    if (pose.shape, box_position.shape) != expected:
        raise ValueError(f"pose and box_position have shapes {pose.shape}, {box_position.shape}: expected {expected}")
    if not (np.isfinite(pose).all() and np.isfinite(box_position[present]).all()):
        raise ValueError("pose or box_position is not finite")
    for name, places in (("pose", pose[:, :2]), ("box_position", box_position[present])):
        cells = xy_to_cell(places, cell_size)
        off = ((cells < 0) | (cells >= GRID_SIZE)).any(-1)
        if off.any():
            side = GRID_SIZE * cell_size / 2
            raise ValueError(f"{name} {places[off][0].tolist()} is off the grid: expected x and y within {side} m of 0")


def hand_over_torque(action: NDArray[np.floating], control: NDArray[np.float64]) -> None:
    """Copy torques to the actuators, [B, U].

    Raises:
        TorqueError: if they have another shape, are not finite or lie outside [-1, 1]; nothing is copied then.
    """
    if action.shape != control.shape:
        raise TorqueError(f"torques have shape {action.shape}: expected {control.shape}")
    if not apply_torque(action, control):
        bad = np.argwhere(~(np.abs(action) <= 1.0))[0]
        raise TorqueError(
            f"torque {action[tuple(bad)]} of actuator {bad[1]} in row {bad[0]}: expected a finite number in [-1, 1]"
        )
