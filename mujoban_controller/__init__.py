"""The visuomotor controller (paper C.3): network, goal task, training, node."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_controller.controller import VisuomotorController

SHIPPED = Path(__file__).parent / "weights" / "controller_ball.safetensors"
"""Weights that ship with the package."""


def load(path: str | Path | None = None, device: str = "cpu") -> VisuomotorController:
    """Return the learned controller with the given or the shipped weights.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit.
    """
    from mujoban_controller.controller import VisuomotorController
    from mujoban_rl.weights import load_weights

    return load_weights(VisuomotorController, path or SHIPPED, device)
