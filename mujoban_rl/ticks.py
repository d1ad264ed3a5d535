"""What controller and control termination see in a tick, as arrays that tensors and graphs take."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput, TerminationInput

TICK = ("frame", "proprio", "instruction", "terminated")
"""Names of these arrays: o_cam, uint8 [B, 64, 64, 3]; o_pr, float32 [B, P]; A, int64 [B]; beta, bool [B]."""


def tick_arrays(inputs: ControllerInput | TerminationInput) -> list[NDArray[Any]]:
    """Return what is seen in a tick, in the order of `TICK`."""
    return [
        np.ascontiguousarray(inputs.frame),
        np.asarray(inputs.proprio, np.float32),
        np.asarray(inputs.instruction, np.int64),
        np.asarray(inputs.terminated, np.bool_),
    ]


def tick_examples(proprio_size: int) -> Iterator[list[NDArray[Any]]]:
    """Yield a fixed tick of one robot for each instruction, in the order of `TICK`."""
    rng = np.random.default_rng(0)
    for instruction in Instruction:
        yield [
            rng.integers(0, 256, (1, FRAME_SIZE, FRAME_SIZE, 3)).astype(np.uint8),
            rng.normal(size=(1, proprio_size)).astype(np.float32),
            np.array([instruction], np.int64),
            np.array([instruction % 2 == 0]),
        ]
