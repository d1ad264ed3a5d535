"""State estimation (paper C.1) and control termination (C.4): networks, bag data, training, evaluation, nodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_estimator.estimator import StateEstimator
    from mujoban_estimator.termination import ControlTermination

SHIPPED = Path(__file__).parent / "weights" / "estimator.safetensors"
"""Weights of the state estimator that ship with the package."""
SHIPPED_TERMINATION = Path(__file__).parent / "weights" / "termination.safetensors"
"""Weights of the control termination that ship with the package."""


def load(path: str | Path | None = None, device: str = "cpu") -> StateEstimator:
    """Return the learned state estimator with the given or the shipped weights.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit.
    """
    from mujoban_estimator.estimator import StateEstimator
    from mujoban_rl.weights import load_weights

    return load_weights(StateEstimator, path or SHIPPED, device)


def load_termination(path: str | Path | None = None, device: str = "cpu") -> ControlTermination:
    """Return the learned control termination with the given or the shipped weights.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit.
    """
    from mujoban_estimator.termination import ControlTermination
    from mujoban_rl.weights import load_weights

    return load_weights(ControlTermination, path or SHIPPED_TERMINATION, device)
