"""What `World` asks of its arguments, and the errors that name what is wrong with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
