"""Checks of what modules answer, in one process and in the graph.

Without them numbers of another shape would be broadcast, and what is no probability would play on as a bad estimate.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import CHANNELS, GRID_SIZE, Instruction


class AnswerError(ValueError):
    """A module answers by something that its role does not have."""


class ModuleError(RuntimeError):
    """A module has failed: an error of its code, and no bad input of the user's, who needs to see where."""


@contextmanager
def answering(role: str) -> Iterator[None]:
    """Name who has failed in a step of the module in a role.

    Raises:
        ModuleError: If it raises a ValueError, which would pass for bad input.
        AnswerError: If it answers by something that its role does not have.
    """
    try:
        yield
    except AnswerError:
        raise
    except ValueError as error:
        raise ModuleError(f"the {role} has failed: {error}") from error


def answer_and_memory(method: str, said: Any) -> tuple[Any, Any]:
    """Return what a module's method has returned, its answer and the memory that comes after it.

    Raises:
        AnswerError: If it is not two values.
    """
    if not isinstance(said, tuple) or len(said) != 2:
        what = f"{len(said)} values" if isinstance(said, tuple) else f"{type(said).__name__}"
        raise AnswerError(f"{method} returns {what}: expected two, the answer and the next memory")
    return said


def estimate_and_memory(said: Any, robots: int) -> tuple[NDArray[np.float32], Any]:
    """Return what an estimator's step has returned: probabilities, [M, N, N, 4], and the memory that comes after it.

    Raises:
        AnswerError: If it is anything else.
    """
    estimate, memory = answer_and_memory("step of the estimator", said)
    check_probabilities("estimator", estimate, (robots, GRID_SIZE, GRID_SIZE, len(CHANNELS)))
    return estimate, memory


def torque_and_memory(said: Any) -> tuple[NDArray[np.float32], Any]:
    """Return what a controller's step has returned: torques, which `check_torques` checks, and the memory after it.

    Raises:
        AnswerError: If it is not two values.
    """
    return answer_and_memory("step of the controller", said)


def check_probabilities(role: str, values: NDArray[np.floating], shape: tuple[int, ...]) -> None:
    """Refuse what a module gives in the place of probabilities of a shape.

    Raises:
        AnswerError: If they are of another shape, or not from 0 to 1.
    """
    check_shape(f"the {role} gives probabilities", values, shape)
    if not are_probabilities(values):
        raise AnswerError(
            f"the {role} gives numbers from {values.min()} to {values.max()}: expected probabilities, from 0 to 1"
        )


def are_probabilities(values: NDArray[np.floating]) -> bool:
    """Return whether all numbers of an array of any shape are from 0 to 1, which NaN is not."""
    # Written so that NaN fails as well.
    return not values.size or bool(values.min() >= 0.0 and values.max() <= 1.0)


def checked_instructions(decision: ArrayLike, robots: int) -> NDArray[np.int64]:
    """Return what a planner decides as an array, [M].

    Raises:
        AnswerError: If it is not one value of `grid.Instruction` for each robot.
    """
    instructions = np.asarray(decision)
    check_shape("the planner decides instructions", instructions, (robots,))
    if not np.issubdtype(instructions.dtype, np.integer):
        raise AnswerError(f"the planner decides {instructions.dtype} numbers: expected values of grid.Instruction")
    # A learned controller would look for it in a table of these, before the world could refuse it.
    if robots and not (instructions.min() >= 0 and instructions.max() < len(Instruction)):
        raise AnswerError(
            f"the planner decides {instructions.min()} to {instructions.max()}: expected values of grid.Instruction, "
            f"from 0 to {len(Instruction) - 1}"
        )
    return instructions


def check_torques(torque: ArrayLike, shape: tuple[int, int]) -> None:
    """Refuse torques of a controller or an agent of another shape than [B, U]; what they may be the world says.

    Raises:
        AnswerError: If they are of another shape.
    """
    check_shape("torques", torque, shape)


def check_shape(what: str, answer: ArrayLike, expected: tuple[int, ...]) -> None:
    """Refuse an answer of another shape.

    Raises:
        AnswerError: If it is of another.
    """
    if np.shape(answer) != expected:
        raise AnswerError(f"{what} of shape {np.shape(answer)}: expected {expected}")
