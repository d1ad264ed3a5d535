"""Export modules as ONNX graphs, which are quick for one robot: `python -m bringup.export [WEIGHTS ...]`.

The graphs lie beside the weights, where the stack finds them (`mujoban_rl.compiled`).
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import tyro

from mujoban_controller.export import export as export_controller
from mujoban_core.bodies import BODIES
from mujoban_core.plugins import ROLES, shipped_weights
from mujoban_core.program import read_options, run_command
from mujoban_estimator.export import export_estimator, export_termination
from mujoban_planner.export import export as export_planner
from mujoban_planner.networks import ARCHITECTURES
from mujoban_rl.compiled import PROGRAM as PROG
from mujoban_rl.weights import WeightsError, read_record

EXPORTERS: Final[Mapping[str, Callable[[Path], Path]]] = {
    "StateEstimator": export_estimator,
    "ControlTermination": export_termination,
    "VisuomotorController": export_controller,
    **dict.fromkeys(ARCHITECTURES, export_planner),
}
"""By the class in a record."""


SHIPPED: Final = tuple(dict.fromkeys(shipped_weights(role, body) for role in ROLES for body in BODIES))


@dataclass(frozen=True)
class Options:
    """Which modules to export."""

    weights: Annotated[tuple[Path, ...], tyro.conf.Positional] = SHIPPED
    """`.safetensors` files with their records beside; all that ship by default."""


def export(weights: Path) -> Path:
    """Write the graph of a weights file beside it, and return where.

    Raises:
        WeightsError: If the weights are missing, damaged or of no module that has a graph.
        ValueError: If `onnxscript` is not installed, which only exporting needs.
    """
    name = read_record(weights)["class"]
    if name not in EXPORTERS:
        raise WeightsError(f"{weights}: weights of {name}, expected one of {', '.join(EXPORTERS)}")
    try:
        return EXPORTERS[name](weights)
    except ModuleNotFoundError as error:
        raise ValueError(str(error)) from error


def main(command_line: Sequence[str] | None = None) -> int:
    """Export, and say where the graphs are."""
    for weights in read_options(Options, command_line, PROG, __doc__).weights:
        path = export(weights)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
