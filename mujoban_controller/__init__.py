"""The visuomotor controller (paper C.3): network, goal task, training, node."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_core.interfaces import Controller

_WEIGHTS = Path(__file__).parent / "weights"


def camera_weights(body: str) -> Path:
    """Return where the weights of a body's camera policy are."""
    return _WEIGHTS / f"controller_{body}.safetensors"


SHIPPED = camera_weights("ball")
"""Weights that ship with the package."""


def teacher_weights(body: str) -> Path:
    """Return where the weights of a body's privileged teacher are; as an oracle it drives what no script can."""
    return _WEIGHTS / f"teacher_{body}.safetensors"


def load(path: str | Path | None = None, device: str = "cpu", *, compiled: bool = True) -> Controller:
    """Return the controller with the given or the shipped weights: a camera policy, or a privileged teacher.

    Args:
        path: A `.safetensors` file with its record beside; the shipped weights by default.
        device: Where the network is put.
        compiled: Whether to look for a graph of it, which only ticks of single robots on a CPU need.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit, or their graph is damaged.
    """
    from mujoban_controller.compiled import STEP, examples
    from mujoban_controller.controller import VisuomotorController
    from mujoban_controller.privileged import PrivilegedPolicy
    from mujoban_rl.compiled import load_graph
    from mujoban_rl.weights import load_weights, read_record

    file = Path(path or SHIPPED)
    if file.is_file() and read_record(file)["class"] == PrivilegedPolicy.__name__:
        from mujoban_controller.privileged_controller import PrivilegedController

        return PrivilegedController(load_weights(PrivilegedPolicy, file, device))
    controller = load_weights(VisuomotorController, file, device)
    if compiled and controller.device.type == "cpu":
        controller.compiled = load_graph(file, read_record(file), STEP, controller.tick, examples(controller))
    return controller
