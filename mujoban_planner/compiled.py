"""One robot's decision as an ONNX graph, which ONNX Runtime takes through the network in less than half of the time.

With a single board most of the time goes into starting hundreds of small operations. The graph is exported from
`LearnedPlanner.weigh` (`python -m mujoban_planner.export`), the implementation that training and batches use, and lies
beside the weights, whose digest it bears. Where it is missing the planner decides as well, in PyTorch.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mujoban_rl.weights import WeightsError

INPUTS: Final = ("states", "seen", "push", "push_alive", "penalty", "caution")
"""Arguments of `LearnedPlanner.weigh`."""
OUTPUTS: Final = ("score", "push_after", "push_alive_after")
"""Fields of `heads.Weighed`."""
DIGEST: Final = "weights"
"""Key of the graph's metadata: SHA-256 of the weights' file."""


class CompiledDecision:
    """`LearnedPlanner.weigh` for a batch of one, on one core."""

    def __init__(self, path: Path) -> None:
        """Compile the graph in a file.

        Raises:
            WeightsError: If it is damaged or not the graph of a decision.
        """
        self.path = path
        self._session = _start(path)

    @classmethod
    def beside(cls, weights: Path, digest: str) -> CompiledDecision | None:
        """Return the graph that lies beside a weights file; None where there is none that can be used.

        Raises:
            WeightsError: If it is damaged or not the graph of a decision.

        Warns:
            UserWarning: If the graph is not that of the weights with this digest.
        """
        path = graph_path(weights)
        if find_spec("onnxruntime") is None or not path.is_file():
            return None
        compiled = cls(path)
        if compiled.digest != digest:
            warnings.warn(
                f"{path}: a graph of other weights than {weights.name}, hence not used; decisions are slower until "
                f"`python -m mujoban_planner.export {weights}` writes a new one",
                stacklevel=2,
            )
            return None
        return compiled

    @property
    def digest(self) -> str:
        """SHA-256 of the file of weights that the graph holds."""
        return self._session.get_modelmeta().custom_metadata_map.get(DIGEST, "")

    def __call__(self, inputs: Sequence[NDArray[Any]]) -> list[NDArray[np.float32]]:
        """Return `OUTPUTS` of `INPUTS`, arrays as `LearnedPlanner.weigh` takes them, of one state."""
        return self._session.run(OUTPUTS, dict(zip(INPUTS, inputs, strict=True)))

    def __reduce__(self) -> tuple[type[CompiledDecision], tuple[Path]]:
        """Compile again where it is copied or sent to another process, as a session can be neither."""
        return type(self), (self.path,)


def graph_path(weights: Path) -> Path:
    """Return where the graph of a weights file lies."""
    return weights.with_suffix(".onnx")


def _start(path: Path) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    again = f"`python -m mujoban_planner.export {path.with_suffix('.safetensors')}` writes a new one"
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors have no class in common
        raise WeightsError(f"{path}: no graph that ONNX Runtime can read: {error}; {again}") from None
    names = tuple(x.name for x in (*session.get_inputs(), *session.get_outputs()))
    if names != INPUTS + OUTPUTS:
        raise WeightsError(f"{path}: a graph of {', '.join(names)}, expected {', '.join(INPUTS + OUTPUTS)}; {again}")
    return session
