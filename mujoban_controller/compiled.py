"""A tick of the camera policy for one robot as a graph (`mujoban_rl.compiled`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from numpy.typing import NDArray

from mujoban_controller.controller import VisuomotorController
from mujoban_rl.compiled import Signature
from mujoban_rl.ticks import TICK, tick_examples

STEP: Final = Signature(
    inputs=(*TICK, "output", "cell", "track"),
    outputs=("torque", "output_after", "cell_after", "track_after"),
    tolerance=0.01,
)
"""`VisuomotorController.tick`."""


def examples(controller: VisuomotorController) -> Iterator[list[NDArray[Any]]]:
    """Yield a fixed input of a tick for each instruction."""
    memory = [part.cpu().numpy() for part in controller.initial_memory(1)]
    for seen in tick_examples(controller.proprio_size):
        yield [*seen, *memory]
