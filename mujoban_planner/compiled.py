"""A planner's decision for one robot as a graph (`mujoban_rl.compiled`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_planner.heads import INSTRUCTIONS, INTERIOR
from mujoban_rl.compiled import Signature

DECISION: Final = Signature(
    inputs=("states", "seen", "push", "push_alive", "penalty", "caution"),
    outputs=("score", "push_after", "push_alive_after", "alive"),
    tolerance=0.05,
)
"""`LearnedPlanner.weigh`."""
_EXAMPLES: Final = 3
"""The board is turned from one to the next."""


def examples() -> Iterator[list[NDArray[Any]]]:
    """Yield a few fixed inputs of a decision."""
    rng = np.random.default_rng(0)
    board = (1, INSTRUCTIONS - 1, INTERIOR, INTERIOR)
    for seen in range(_EXAMPLES):
        inputs = [
            rng.random((1, GRID_SIZE, GRID_SIZE, len(CHANNELS))) > rng.random(),
            np.array([seen], np.int64),
            *(rng.normal(size=board) for _ in range(3)),
            np.array(rng.uniform(1, 4)),
        ]
        yield [x if x.dtype == np.int64 else x.astype(np.float32) for x in inputs]
