"""A tick of the control termination for one robot as a graph (`mujoban_rl.compiled`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import Instruction
from mujoban_estimator.odometry import Track
from mujoban_estimator.termination import ControlTermination
from mujoban_rl.compiled import Signature

_MEMORY: Final = ("hidden", "cell", *Track._fields)

TICK: Final = Signature(
    inputs=("frame", "proprio", "instruction", "terminated", *_MEMORY),
    outputs=("probability", *(f"{name}_after" for name in _MEMORY)),
    program="mujoban_estimator.export",
    tolerance=0.01,
)
"""`ControlTermination.tick`."""


def examples(termination: ControlTermination) -> Iterator[list[NDArray[Any]]]:
    """Yield a fixed input of a tick for each instruction."""
    rng = np.random.default_rng(0)
    hidden, cell, track = termination.initial_memory(1)
    size = get_body(termination.config.body).proprio_size
    for instruction in Instruction:
        yield [
            rng.integers(0, 256, (1, FRAME_SIZE, FRAME_SIZE, 3)).astype(np.uint8),
            rng.normal(size=(1, size)).astype(np.float32),
            np.array([instruction], np.int64),
            np.array([instruction % 2 == 0]),
            *(part.cpu().numpy() for part in (hidden, cell, *track)),
        ]
