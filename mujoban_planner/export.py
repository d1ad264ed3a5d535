"""A planner's decision as an ONNX graph."""

from __future__ import annotations

from pathlib import Path

import torch

from mujoban_planner import load
from mujoban_planner.compiled import DECISION, examples
from mujoban_rl.export import export_graph


def export(weights: Path) -> Path:
    """Write the graph of a planner's weights beside them, and return where; see `export_graph`."""
    planner = load(weights, compiled=False)
    return export_graph(weights, planner, planner.weigh, [torch.from_numpy(x) for x in next(examples())], DECISION)
