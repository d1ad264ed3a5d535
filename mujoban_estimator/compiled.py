"""What estimator and control termination do in a tick, for one robot, as graphs (`mujoban_rl.compiled`)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_estimator.estimator import StateEstimator
from mujoban_estimator.geometry import cell_geometry
from mujoban_estimator.odometry import Track
from mujoban_estimator.termination import ControlTermination, parts_of
from mujoban_rl.compiled import Signature
from mujoban_rl.ticks import TICK, tick_examples

UPDATE: Final = Signature(
    inputs=("frame", "relative", "pixels", "visible", "hidden", "cell"),
    outputs=("estimate", "hidden_after", "cell_after"),
    tolerance=0.01,
)
"""`StateEstimator.update`."""
_EXAMPLES: Final = 3


def step_signature(termination: ControlTermination) -> Signature:
    """Return the signature of `ControlTermination.tick`; a body that does not feel its heading has needles."""
    memory = ["hidden", "cell", *Track._fields, *(["needles"] if termination.bearings is not None else [])]
    return Signature((*TICK, *memory), ("probability", *(f"{name}_after" for name in memory)), tolerance=0.01)


def update_examples(estimator: StateEstimator) -> Iterator[list[NDArray[Any]]]:
    """Yield a few fixed inputs of an update, from different places."""
    rng = np.random.default_rng(0)
    body, belief = estimator.body, estimator.initial_belief(1)
    for place in range(_EXAMPLES):
        pose = np.array([[0.7 * place * body.cell_size, 0.4 * body.cell_size, 1.3 * place]])
        yield [
            rng.integers(0, 256, (1, FRAME_SIZE, FRAME_SIZE, 3)).astype(np.uint8),
            *cell_geometry(pose, body.camera, body.cell_size),
            *(part.cpu().numpy() for part in belief),
        ]


def step_examples(termination: ControlTermination) -> Iterator[list[NDArray[Any]]]:
    """Yield a fixed input of a tick for each instruction."""
    memory = [part.cpu().numpy() for part in parts_of(termination.initial_memory(1))]
    for seen in tick_examples(get_body(termination.config.body).proprio_size):
        yield [*seen, *memory]
