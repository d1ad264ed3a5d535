"""Export a tick of a camera policy as an ONNX graph: `python -m mujoban_controller.export [WEIGHTS]`.

The graph lies beside the weights and makes the tick of one robot faster (`mujoban_rl.compiled`).
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from mujoban_controller import SHIPPED
from mujoban_controller.compiled import STEP, examples
from mujoban_controller.controller import VisuomotorController
from mujoban_core.program import read_options, run_command
from mujoban_rl.export import export_graph, tell
from mujoban_rl.weights import load_weights

PROG = STEP.program


@dataclass(frozen=True)
class Options:
    """Which camera policy to export."""

    weights: Annotated[Path, tyro.conf.Positional] = SHIPPED
    """A `.safetensors` file with its record beside."""


def export(weights: Path) -> Path:
    """Write the graph of a weights file beside it, and return where.

    Raises:
        WeightsError: If the weights are missing, damaged or of no camera policy.
        ModuleNotFoundError: If `onnxscript` is not installed, which only exporting needs.
    """
    controller = load_weights(VisuomotorController, weights)
    inputs = [torch.from_numpy(x) for x in next(examples(controller))]
    return export_graph(weights, controller, controller.tick, inputs, STEP)


def main(command_line: Sequence[str] | None = None) -> int:
    """Export, and say where the graph is."""
    tell(export, read_options(Options, command_line, PROG, __doc__).weights)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
