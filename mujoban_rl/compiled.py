"""A module's step for one robot as an ONNX graph, which ONNX Runtime takes through it in less than half of the time.

With a batch of one most of the time goes into starting hundreds of small operations. A graph is exported from the
function that training and batches use, the one implementation (`mujoban_rl.export`), and lies beside the weights, whose
record has its digest. Where it is missing the module computes as well, in PyTorch.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_rl.weights import WEIGHTS_LIMIT, WeightsError, read_bounded

DIGEST: Final = "graph"
"""Key of the weights' record: SHA-256 of the graph's file."""

PROGRAM: Final = "bringup.export"
"""Module that writes graphs, by `python -m`."""

Arrays = Sequence[NDArray[Any]]


class Signature(NamedTuple):
    """What a graph takes and returns."""

    inputs: tuple[str, ...]
    """Names of the function's arguments, in their order."""
    outputs: tuple[str, ...]
    """Names of what it returns, none of them that of an input."""
    tolerance: float
    """Difference of a value that the order of additions may make."""


class CompiledGraph:
    """A function of tensors, for a batch of one, on one core."""

    def __init__(self, path: Path, digest: str, signature: Signature) -> None:
        """Compile the graph in a file.

        Raises:
            WeightsError: If it is damaged, not the one with this SHA-256, or of another signature.
        """
        self.path, self.digest, self.signature = path, digest, signature
        self._session = _start(path, digest, signature)

    @classmethod
    def beside(cls, weights: Path, record: Mapping[str, Any], signature: Signature) -> CompiledGraph | None:
        """Return the graph that lies beside a weights file; None where there is none that can be used.

        Args:
            weights: The file of weights.
            record: Their record.
            signature: What the graph has to take and return.

        Raises:
            WeightsError: If it is damaged or of another signature.

        Warns:
            UserWarning: If the weights' record knows no graph.
        """
        path = graph_path(weights)
        if find_spec("onnxruntime") is None or not path.is_file():
            return None
        if DIGEST not in record:
            warnings.warn(
                f"{path}: a graph of other weights than {weights.name}, hence not used; a step is slower until "
                f"`python -m {PROGRAM} {weights}` writes a new one",
                stacklevel=2,
            )
            return None
        return cls(path, record[DIGEST], signature)

    def check(self, function: Callable[..., Sequence[Any]], examples: Iterable[Arrays]) -> None:
        """Compare the graph with the function that it should be of.

        Args:
            function: On tensors.
            examples: Inputs.

        Raises:
            WeightsError: If one of them says something else or something that is no number.
        """
        signature = self.signature
        for arrays in examples:
            with torch.inference_mode():
                expected = [x.numpy() for x in function(*map(torch.from_numpy, arrays))]
            for name, said, wanted in zip(signature.outputs, self(arrays), expected, strict=True):
                if not np.allclose(said, wanted, atol=signature.tolerance, rtol=1e-3):
                    raise WeightsError(f"{self.path}: its {name} is not that of the weights; {_again(self.path)}")

    def __call__(self, inputs: Arrays) -> list[NDArray[Any]]:
        """Return the outputs of inputs, arrays as the function takes them, with a batch of one."""
        return self._session.run(self.signature.outputs, dict(zip(self.signature.inputs, inputs, strict=True)))

    def __reduce__(self) -> tuple[type[CompiledGraph], tuple[Path, str, Signature]]:
        """Compile again where it is copied or sent to another process, as a session can be neither."""
        return type(self), (self.path, self.digest, self.signature)


class Compilable(nn.Module):
    """A module that may have a graph of its step for one robot."""

    compiled: CompiledGraph | None = None
    """Of the weights that were loaded."""

    def train(self, mode: bool = True) -> Self:
        """Set training mode, whose new weights the graph would not have."""
        if mode:
            self.compiled = None
        return super().train(mode)


def bounded_sigmoid(logits: Tensor) -> Tensor:
    """Return the probabilities of logits, of any shape, at most 1: ONNX Runtime's sigmoid can exceed it by rounding."""
    return torch.sigmoid(logits).clamp(max=1.0)


def load_graph(
    weights: Path, record: Mapping[str, Any], signature: Signature, function: Callable[..., Sequence[Any]],
    examples: Iterable[Arrays],
) -> CompiledGraph | None:  # fmt: skip
    """Return the graph beside a weights file, which says on some inputs what its function says; None without one.

    Raises:
        WeightsError: If it is damaged, of another signature, or says something else.
    """
    graph = CompiledGraph.beside(weights, record, signature)
    if graph is not None:
        graph.check(function, examples)
    return graph


def graph_path(weights: Path) -> Path:
    """Return where the graph of a weights file lies."""
    return weights.with_suffix(".onnx")


def _again(path: Path) -> str:
    return f"`python -m {PROGRAM} {path.with_suffix('.safetensors')}` writes a new one"


def _start(path: Path, digest: str, signature: Signature) -> Any:
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
    if names != (expected := signature.inputs + signature.outputs):
        raise WeightsError(f"{path}: a graph of {', '.join(names)}, expected {', '.join(expected)}; {again}")
    return session
