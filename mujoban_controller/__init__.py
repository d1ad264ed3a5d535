"""The visuomotor controller (paper C.3): network, goal task, training, node."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_core.interfaces import Controller

_WEIGHTS = Path(__file__).parent / "weights"
SHIPPED = _WEIGHTS / "controller_ball.safetensors"
"""Weights that ship with the package."""


def teacher_weights(body: str) -> Path:
    """Return where the weights of a body's privileged teacher are; as an oracle it drives what no script can."""
    return _WEIGHTS / f"teacher_{body}.safetensors"


def load(path: str | Path | None = None, device: str = "cpu") -> Controller:
    """Return the controller with the given or the shipped weights: a camera policy, or a privileged teacher.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit.
    """
    from mujoban_controller.controller import VisuomotorController
    from mujoban_controller.privileged import PrivilegedPolicy
    from mujoban_rl.weights import load_weights, read_record

    file = Path(path or SHIPPED)
    if file.is_file() and read_record(file)["class"] == PrivilegedPolicy.__name__:
        from mujoban_controller.privileged_controller import PrivilegedController

        return PrivilegedController(load_weights(PrivilegedPolicy, file, device))
    return load_weights(VisuomotorController, file, device)
