"""Checks of what modules answer where they play in one process; in the graph, messages refuse the same.

Without them numbers of another shape would be broadcast, and what is no probability would play on as a bad estimate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import Instruction


def check_probabilities(role: str, values: NDArray[np.floating], shape: tuple[int, ...]) -> None:
    """Refuse what a module gives in the place of probabilities of a shape.

    Raises:
        ValueError: If they are of another shape, or not from 0 to 1.
    """
    _check_shape(f"the {role} gives probabilities", values.shape, shape)
    if not are_probabilities(values):
        raise ValueError(
            f"the {role} gives numbers from {values.min()} to {values.max()}: expected probabilities, from 0 to 1"
        )


def are_probabilities(values: NDArray[np.floating]) -> bool:
    """Return whether all numbers of an array of any shape are from 0 to 1, which NaN is not."""
    # Written so that NaN fails as well.
    return not values.size or bool(values.min() >= 0.0 and values.max() <= 1.0)


def checked_instructions(decision: ArrayLike, robots: int) -> NDArray[np.int64]:
    """Return what a planner decides as an array, [M].

    Raises:
        ValueError: If it is not one value of `grid.Instruction` for each robot.
    """
    instructions = np.asarray(decision)
    _check_shape("the planner decides instructions", instructions.shape, (robots,))
    if not np.issubdtype(instructions.dtype, np.integer):
        raise ValueError(f"the planner decides {instructions.dtype} numbers: expected values of grid.Instruction")
    # A learned controller would look for it in a table of these, before the world could refuse it.
    if robots and not (instructions.min() >= 0 and instructions.max() < len(Instruction)):
        raise ValueError(
            f"the planner decides {instructions.min()} to {instructions.max()}: expected values of grid.Instruction, "
            f"from 0 to {len(Instruction) - 1}"
        )
    return instructions


def check_torques(torque: NDArray[np.float32], shape: tuple[int, int]) -> None:
    """Refuse torques of a controller or an agent of another shape than [B, U]; what they may be the world says.

    Raises:
        ValueError: If they are of another shape.
    """
    _check_shape("torques", np.shape(torque), shape)


def _check_shape(what: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if shape != expected:
        raise ValueError(f"{what} of shape {shape}: expected {expected}")
