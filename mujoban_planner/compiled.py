"""One robot's decision as an ONNX graph, which ONNX Runtime takes through the network in less than half of the time.

With a single board most of the time goes into starting hundreds of small operations. The graph is exported from
`LearnedPlanner.weigh` (`python -m mujoban_planner.export`), the implementation that training and batches use, and lies
beside the weights, whose record has its digest. Where it is missing the planner decides as well, in PyTorch.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.grid import CHANNELS, GRID_SIZE
from mujoban_planner.heads import INSTRUCTIONS, INTERIOR
from mujoban_rl.weights import WEIGHTS_LIMIT, WeightsError, read_bounded

INPUTS: Final = ("states", "seen", "push", "push_alive", "penalty", "caution")
"""Arguments of `LearnedPlanner.weigh`."""
OUTPUTS: Final = ("score", "push_after", "push_alive_after")
"""Fields of `heads.Weighed`."""
DIGEST: Final = "graph"
"""Key of the weights' record: SHA-256 of the graph's file."""


_CHECKS: Final = 3
"""States on which a graph is compared with its weights; the board is turned from one to the next."""
_TOLERANCE: Final = 0.05
"""Difference of a score that the order of additions may make."""


class CompiledDecision:
    """`LearnedPlanner.weigh` for a batch of one, on one core."""

    def __init__(self, path: Path, digest: str) -> None:
        """Compile the graph in a file.

        Raises:
            WeightsError: If it is damaged, not the one with this SHA-256, or not the graph of a decision.
        """
        self.path, self.digest = path, digest
        self._session = _start(path, digest)

    @classmethod
    def beside(cls, weights: Path, record: Mapping[str, Any]) -> CompiledDecision | None:
        """Return the graph that lies beside a weights file; None where there is none that can be used.

        Args:
            weights: The file of weights.
            record: Their record.

        Raises:
            WeightsError: If it is damaged or not the graph of a decision.

        Warns:
            UserWarning: If the weights' record knows no graph.
        """
        path = graph_path(weights)
        if find_spec("onnxruntime") is None or not path.is_file():
            return None
        if DIGEST not in record:
            warnings.warn(
                f"{path}: a graph of other weights than {weights.name}, hence not used; decisions are slower until "
                f"`python -m mujoban_planner.export {weights}` writes a new one",
                stacklevel=2,
            )
            return None
        return cls(path, record[DIGEST])

    def check(self, weigh: Callable[..., Sequence[Any]]) -> None:
        """Compare the graph with the network that it should be of, on a few fixed states.

        Args:
            weigh: `LearnedPlanner.weigh`, on tensors.

        Raises:
            WeightsError: If one of them says something else or something that is no number.
        """
        rng = np.random.default_rng(0)
        board = (1, INSTRUCTIONS - 1, INTERIOR, INTERIOR)
        for seen in range(_CHECKS):
            inputs = [
                rng.random((1, GRID_SIZE, GRID_SIZE, len(CHANNELS))) > rng.random(),
                np.array([seen], np.int64),
                *(rng.normal(size=board) for _ in range(3)),
                np.array(rng.uniform(1, 4)),
            ]
            arrays = [x if x.dtype == np.int64 else x.astype(np.float32) for x in inputs]
            with torch.inference_mode():
                expected = [x.numpy() for x in weigh(*map(torch.from_numpy, arrays))]
            for name, said, wanted in zip(OUTPUTS, self(arrays), expected, strict=True):
                if not np.allclose(said, wanted, atol=_TOLERANCE, rtol=1e-3):
                    raise WeightsError(f"{self.path}: its {name} is not that of the weights; {_again(self.path)}")

    def __call__(self, inputs: Sequence[NDArray[Any]]) -> list[NDArray[np.float32]]:
        """Return `OUTPUTS` of `INPUTS`, arrays as `LearnedPlanner.weigh` takes them, of one state."""
        return self._session.run(OUTPUTS, dict(zip(INPUTS, inputs, strict=True)))

    def __reduce__(self) -> tuple[type[CompiledDecision], tuple[Path, str]]:
        """Compile again where it is copied or sent to another process, as a session can be neither."""
        return type(self), (self.path, self.digest)


def graph_path(weights: Path) -> Path:
    """Return where the graph of a weights file lies."""
    return weights.with_suffix(".onnx")


def _again(path: Path) -> str:
    return f"`python -m mujoban_planner.export {path.with_suffix('.safetensors')}` writes a new one"


def _start(path: Path, digest: str) -> Any:
    # It would look up a host and keep records of this machine in the home folder; it asks on being imported.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    again = _again(path)
    data = read_bounded(path, WEIGHTS_LIMIT)
    if (found := hashlib.sha256(data).hexdigest()) != digest:
        raise WeightsError(f"{path}: damaged or not the graph of its record: SHA-256 is {found}, not {digest}; {again}")

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors have no class in common
        raise WeightsError(f"{path}: no graph that ONNX Runtime can read: {error}; {again}") from None
    names = tuple(x.name for x in (*session.get_inputs(), *session.get_outputs()))
    if names != INPUTS + OUTPUTS:
        raise WeightsError(f"{path}: a graph of {', '.join(names)}, expected {', '.join(INPUTS + OUTPUTS)}; {again}")
    return session
