"""State estimation (paper C.1) and control termination (C.4): networks, bag data, training, evaluation, nodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_estimator.estimator import StateEstimator
    from mujoban_estimator.termination import ControlTermination

SHIPPED = Path(__file__).parent / "weights" / "estimator.safetensors"
"""Weights of the state estimator that ship with the package."""
SHIPPED_TERMINATION = Path(__file__).parent / "weights" / "termination.safetensors"
"""Weights of the control termination that ship with the package."""


def load(path: str | Path | None = None, device: str = "cpu", *, compiled: bool = True) -> StateEstimator:
    """Return the learned state estimator with the given or the shipped weights.

    Args:
        path: A `.safetensors` file with its record beside; the shipped weights by default.
        device: Where the network is put.
        compiled: Whether to look for a graph of it, which only updates of single robots on a CPU need.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit, or their graph is damaged.
    """
    from mujoban_estimator.compiled import UPDATE, update_examples
    from mujoban_estimator.estimator import StateEstimator
    from mujoban_rl.compiled import load_graph
    from mujoban_rl.weights import load_weights, read_record

    file = Path(path or SHIPPED)
    estimator = load_weights(StateEstimator, file, device)
    if compiled and estimator.device.type == "cpu":
        examples = update_examples(estimator)
        estimator.compiled = load_graph(file, read_record(file), UPDATE, estimator.update, examples)
    return estimator


def load_termination(
    path: str | Path | None = None, device: str = "cpu", *, compiled: bool = True
) -> ControlTermination:
    """Return the learned control termination with the given or the shipped weights.

    Args:
        path: A `.safetensors` file with its record beside; the shipped weights by default.
        device: Where the network is put.
        compiled: Whether to look for a graph of it, which only ticks of single robots on a CPU need.

    Raises:
        mujoban_rl.weights.WeightsError: If the weights are missing, damaged or do not fit, or their graph is damaged.
    """
    from mujoban_estimator.compiled import step_examples, step_signature
    from mujoban_estimator.termination import ControlTermination
    from mujoban_rl.compiled import load_graph
    from mujoban_rl.weights import load_weights, read_record

    file = Path(path or SHIPPED_TERMINATION)
    termination = load_weights(ControlTermination, file, device)
    if compiled and termination.device.type == "cpu":
        signature, examples = step_signature(termination), step_examples(termination)
        termination.compiled = load_graph(file, read_record(file), signature, termination.tick, examples)
    return termination
