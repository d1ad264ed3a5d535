"""Export estimators and control terminations as ONNX graphs: `python -m mujoban_estimator.export [WEIGHTS ...]`.

The graphs lie beside the weights and make the tick of one robot faster (`mujoban_rl.compiled`).
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

from mujoban_core.program import read_options, run_command
from mujoban_estimator import SHIPPED, SHIPPED_TERMINATION, load, load_termination
from mujoban_estimator.compiled import STEP, UPDATE, step_examples, update_examples
from mujoban_estimator.estimator import StateEstimator
from mujoban_rl.export import export_graph, tell
from mujoban_rl.weights import read_record

PROG = STEP.program


@dataclass(frozen=True)
class Options:
    """Which estimators and control terminations to export."""

    weights: Annotated[tuple[Path, ...], tyro.conf.Positional] = (SHIPPED, SHIPPED_TERMINATION)
    """`.safetensors` files with their records beside."""


def export(weights: Path) -> Path:
    """Write the graph of a weights file beside it, and return where.

    Raises:
        WeightsError: If the weights are missing, damaged or of neither.
        ModuleNotFoundError: If `onnxscript` is not installed, which only exporting needs.
    """
    if read_record(weights)["class"] == StateEstimator.__name__:
        module = load(weights, compiled=False)
        function, signature, inputs = module.update, UPDATE, next(update_examples(module))
    else:
        module = load_termination(weights, compiled=False)
        function, signature, inputs = module.tick, STEP, next(step_examples(module))
    return export_graph(weights, module, function, [torch.from_numpy(x) for x in inputs], signature)


def main(command_line: Sequence[str] | None = None) -> int:
    """Export, and say where the graph is."""
    for weights in read_options(Options, command_line, PROG, __doc__).weights:
        tell(export, weights)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
