"""The planner: abstract state -> instruction (paper C.2)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from mujoban_planner.planner import LearnedPlanner

SHIPPED = Path(__file__).parent / "weights" / "planner.safetensors"
"""The weights that ship."""


def load(
    path: str | Path | None = None, device: str | torch.device = "cpu", *, compiled: bool = True
) -> LearnedPlanner:
    """Return a planner with trained weights, of the architecture in their record, and its graph if there is one.

    Args:
        path: A `.safetensors` file with its record beside; the shipped weights by default.
        device: Where the network is put.
        compiled: Whether to look for a graph, which only decisions of single robots on a CPU need.

    Raises:
        WeightsError: If the weights are missing, damaged, or of no known architecture, or their graph is damaged.
    """
    from mujoban_planner.compiled import DECISION, examples
    from mujoban_planner.networks import ARCHITECTURES
    from mujoban_rl.compiled import load_graph
    from mujoban_rl.weights import WeightsError, load_weights, read_record

    weights = Path(path or SHIPPED)
    record = read_record(weights)
    name = record["class"]
    if name not in ARCHITECTURES:
        raise WeightsError(f"{weights}: holds weights of {name}, expected one of {', '.join(ARCHITECTURES)}")
    planner = load_weights(ARCHITECTURES[name], weights, device)
    planner.lay_out()
    if compiled and next(planner.parameters()).device.type == "cpu":
        planner.compiled = load_graph(weights, record, DECISION, planner.weigh, examples())
    return planner


__all__ = ["SHIPPED", "load"]
