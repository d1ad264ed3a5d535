"""A tick of a camera policy as an ONNX graph."""

from __future__ import annotations

from pathlib import Path

import torch

from mujoban_controller.compiled import STEP, examples
from mujoban_controller.controller import VisuomotorController
from mujoban_rl.export import export_graph
from mujoban_rl.weights import load_weights


def export(weights: Path) -> Path:
    """Write the graph of a camera policy's weights beside them, and return where; see `export_graph`."""
    controller = load_weights(VisuomotorController, weights)
    inputs = [torch.from_numpy(x) for x in next(examples(controller))]
    return export_graph(weights, controller, controller.tick, inputs, STEP)
