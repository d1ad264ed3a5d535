"""Export a planner's decision as an ONNX graph: `python -m mujoban_planner.export [WEIGHTS]`.

The graph lies beside the weights and makes the decision of one robot faster (`compiled`). Any other ONNX runtime can
run it too: it holds the weights, takes `compiled.INPUTS` and returns `compiled.OUTPUTS`, with a batch of one.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor, nn

from mujoban_core.files import digest, write_atomically
from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_core.program import read_options, run_command
from mujoban_planner import SHIPPED, load
from mujoban_planner.compiled import DIGEST, INPUTS, OUTPUTS, graph_path
from mujoban_planner.heads import INSTRUCTIONS, INTERIOR, Weighed
from mujoban_planner.planner import LearnedPlanner
from mujoban_rl.weights import read_record, record_path

PROG = "mujoban_planner.export"


@dataclass(frozen=True)
class Options:
    """Which planner to export."""

    weights: Annotated[Path, tyro.conf.Positional] = SHIPPED
    """A `.safetensors` file with its record beside."""


class _Decision(nn.Module):
    """`LearnedPlanner.weigh` as a module."""

    def __init__(self, planner: LearnedPlanner) -> None:
        super().__init__()
        self.planner = planner

    def forward(self, *inputs: Tensor) -> Weighed:
        return self.planner.weigh(*inputs)


def export(weights: Path) -> Path:
    """Write the graph of a weights file beside it, and return where.

    Raises:
        WeightsError: If the weights are missing or damaged.
        ModuleNotFoundError: If `onnxscript` is not installed, which only exporting needs.
    """
    if find_spec("onnxscript") is None:
        raise ModuleNotFoundError("exporting needs onnxscript, which is part of mujoban[dev]: pip install onnxscript")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    program = torch.onnx.export(
        _Decision(load(weights, compiled=False)).eval(),
        example_inputs(),
        dynamo=True,
        input_names=INPUTS,
        output_names=OUTPUTS,
        verbose=False,
    )
    assert program is not None
    model = program.model
    _strip(model.graph.all_nodes())
    _strip([model, model.graph, *model.graph.inputs, *model.graph.outputs, *model.graph.initializers.values()])
    path = graph_path(weights)
    write_atomically(path, program.model_proto.SerializeToString())
    record = read_record(weights) | {DIGEST: digest(path)}
    write_atomically(record_path(weights), (json.dumps(record, indent=2) + "\n").encode())
    return path


def example_inputs() -> tuple[Tensor, ...]:
    """Return inputs of the shapes that the graph takes."""
    board = torch.zeros(1, INSTRUCTIONS - 1, INTERIOR, INTERIOR)
    states = torch.zeros(1, GRID_SIZE, GRID_SIZE, len(CHANNELS))
    return states, torch.zeros(1, dtype=torch.int64), board, board.clone(), board.clone(), torch.tensor(1.0)


def _strip(parts: Iterable[Any]) -> None:
    """Forget where in the source each part comes from, which names folders of this machine."""
    for part in parts:
        part.metadata_props.clear()
        part.doc_string = None


def main(command_line: Sequence[str] | None = None) -> int:
    """Export, and say where the graph is."""
    options = read_options(Options, command_line, PROG, __doc__)
    try:
        path = export(options.weights)
    except ModuleNotFoundError as error:
        raise ValueError(str(error)) from error
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
