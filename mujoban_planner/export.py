"""Export a planner's decision as an ONNX graph: `python -m mujoban_planner.export [WEIGHTS]`.

The graph lies beside the weights and makes the decision of one robot faster (`mujoban_rl.compiled`).
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
from mujoban_planner import SHIPPED, load
from mujoban_planner.compiled import DECISION, examples
from mujoban_rl.export import export_graph, tell

PROG = DECISION.program


@dataclass(frozen=True)
class Options:
    """Which planner to export."""

    weights: Annotated[Path, tyro.conf.Positional] = SHIPPED
    """A `.safetensors` file with its record beside."""


def export(weights: Path) -> Path:
    """Write the graph of a weights file beside it, and return where.

    Raises:
        WeightsError: If the weights are missing or damaged.
        ModuleNotFoundError: If `onnxscript` is not installed, which only exporting needs.
    """
    planner = load(weights, compiled=False)
    return export_graph(weights, planner, planner.weigh, [torch.from_numpy(x) for x in next(examples())], DECISION)


def main(command_line: Sequence[str] | None = None) -> int:
    """Export, and say where the graph is."""
    tell(export, read_options(Options, command_line, PROG, __doc__).weights)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
