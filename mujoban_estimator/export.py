"""Estimator and control termination as ONNX graphs."""

from __future__ import annotations

from pathlib import Path

import torch

from mujoban_estimator import load, load_termination
from mujoban_estimator.compiled import UPDATE, step_examples, step_signature, update_examples
from mujoban_rl.export import export_graph


def export_estimator(weights: Path) -> Path:
    """Write the graph of an estimator's weights beside them, and return where; see `export_graph`."""
    estimator = load(weights, compiled=False)
    inputs = [torch.from_numpy(x) for x in next(update_examples(estimator))]
    return export_graph(weights, estimator, estimator.update, inputs, UPDATE)


def export_termination(weights: Path) -> Path:
    """Write the graph of a control termination's weights beside them, and return where; see `export_graph`."""
    termination = load_termination(weights, compiled=False)
    inputs = [torch.from_numpy(x) for x in next(step_examples(termination))]
    return export_graph(weights, termination, termination.tick, inputs, step_signature(termination))
