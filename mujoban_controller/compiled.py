"""A tick of the camera policy for one robot as a graph (`mujoban_rl.compiled`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mujoban_controller.controller import VisuomotorController
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import Instruction
from mujoban_rl.compiled import Signature

TICK: Final = Signature(
    inputs=("frame", "proprio", "instruction", "terminated", "output", "cell", "track"),
    outputs=("torque", "output_after", "cell_after", "track_after"),
    program="mujoban_controller.export",
    tolerance=0.01,
)
"""`VisuomotorController.tick`."""


def examples(controller: VisuomotorController) -> Iterator[list[NDArray[Any]]]:
    """Yield a fixed input of a tick for each instruction."""
    rng = np.random.default_rng(0)
    memory = controller.initial_memory(1)
    for instruction in Instruction:
        yield [
            rng.integers(0, 256, (1, FRAME_SIZE, FRAME_SIZE, 3)).astype(np.uint8),
            rng.normal(size=(1, controller.proprio_size)).astype(np.float32),
            np.array([instruction], np.int64),
            np.array([instruction % 2 == 0]),
            *(part.cpu().numpy() for part in memory),
        ]
