"""Export a module's step for one robot as an ONNX graph beside its weights (`compiled`).

Any other ONNX runtime can run it too: it holds the weights, and has a batch of one.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mujoban_core.files import digest, write_atomically
from mujoban_rl.compiled import DIGEST, Signature, graph_path
from mujoban_rl.weights import read_record, record_path


class _Step(nn.Module):
    """A function of a module as a module."""

    def __init__(self, module: nn.Module, function: Callable[..., Sequence[Tensor]]) -> None:
        super().__init__()
        self.module, self._function = module, function

    def forward(self, *inputs: Tensor) -> Sequence[Tensor]:
        return self._function(*inputs)


def export_graph(
    weights: Path, module: nn.Module, function: Callable[..., Sequence[Tensor]], inputs: Sequence[Tensor],
    signature: Signature,
) -> Path:  # fmt: skip
    """Write the graph of a function beside a weights file, with its digest in their record, and return where.

    Args:
        weights: File of the module's weights.
        module: What was loaded from it.
        function: Of the module, from the inputs to the outputs of the signature.
        inputs: Tensors of the shapes that it takes.
        signature: Names of both.

    Raises:
        WeightsError: If the weights' record is missing or damaged.
        ModuleNotFoundError: If `onnxscript` is not installed, which only exporting needs.
    """
    if find_spec("onnxscript") is None:
        raise ModuleNotFoundError("exporting needs onnxscript, which is part of mujoban[dev]: pip install onnxscript")
    with torch.no_grad():
        function(*inputs)  # what it computes but once and keeps would be the tracer's own tensors
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # Of PyTorch about its own parts.
        warnings.filterwarnings("ignore", "`isinstance\\(treespec, LeafSpec\\)` is deprecated")
        warnings.filterwarnings("ignore", "The tensor attributes .* were assigned during export")
        program = torch.onnx.export(
            _Step(module, function).eval(),
            tuple(inputs),
            dynamo=True,
            input_names=signature.inputs,
            output_names=signature.outputs,
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


def _strip(parts: Iterable[Any]) -> None:
    """Forget where in the source each part comes from, which names folders of this machine."""
    for part in parts:
        part.metadata_props.clear()
        part.doc_string = None

