"""Start a planner network from the weights of a smaller one, so that it says the same at first; note which they are.

Further residual blocks begin as the identity (`ResidualBlock`). Further channels compute something from the start, but
nothing that was there listens to them yet; training makes it listen.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mujoban_core.files import digest
from mujoban_planner import load
from mujoban_planner.networks import RecurrentPlanner
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import WeightsError, check_weights_exist

_SAME = ("propagation", "judge")
_POOLED = "inject.linear.weight"
"""Weights whose inputs are two values for each channel."""


def beginning(config: NetworkConfig, init: str | Path | None) -> LearnedPlanner:
    """Return the network that a run begins with: as drawn, or with the weights of a trained planner.

    Raises:
        WeightsError: See `start_from`.
    """
    network = config.build()
    if init is not None:
        start_from(network, Path(init))
    network.lay_out()
    return network


def begun_with(init: str | Path | None) -> dict[str, str] | None:
    """Return by what a run knows the weights again that it begins with: name and digest of their file; None for none.

    Raises:
        WeightsError: If there is no such file.
    """
    if init is None:
        return None
    check_weights_exist(init)
    return {"path": Path(init).name, "digest": digest(init)}


def open_run(directory: Path, config: Any) -> RunDirectory:
    """Open or reopen the directory of a run whose configuration has an option `init`.

    Its weights are read again when the run is resumed, so that they must not change meanwhile.

    Raises:
        RunError: If it belongs to another run, or the file of the weights was another when this one began.
        WeightsError: If there is no such file.
    """
    return RunDirectory(directory, config, beside={"begun_with": begun_with(config.init)})


def start_from(network: LearnedPlanner, path: Path) -> None:
    """Give a network the weights of a trained planner that has the same or fewer channels and blocks.

    One that repeats its last blocks may begin with those of one that does not.

    Raises:
        WeightsError: If the file is damaged, or its planner has another architecture, or more channels or blocks, or is
            a smaller recurrent one, whose gates cannot grow, or differs in `propagation` or `judge`.
    """
    trained = load(path, compiled=False)
    ours, theirs = dict(network.named_parameters()), dict(trained.named_parameters())
    fits = isinstance(network, type(trained)) and all(k in ours and _holds(ours[k], v) for k, v in theirs.items())
    # Without what it rests on, a rule or a head would say something else from the start.
    fits = fits and all(trained.config[name] == network.config[name] for name in _SAME)
    if isinstance(network, RecurrentPlanner):
        fits = fits and all(ours[k].shape == v.shape for k, v in theirs.items())
    if not fits:
        raise WeightsError(
            f"{path}: a {type(trained).__name__} of {trained.config}, expected a {type(network).__name__} with at most "
            f"the channels and blocks of {network.config}"
        )
    with torch.no_grad():
        for name, weight in theirs.items():
            _embed(ours[name], weight, pooled=name.endswith(_POOLED))


def _holds(larger: Tensor, smaller: Tensor) -> bool:
    return larger.dim() == smaller.dim() and all(n >= m for n, m in zip(larger.shape, smaller.shape, strict=True))


def _embed(larger: Tensor, smaller: Tensor, *, pooled: bool) -> None:
    """Copy weights [O, I, ...] into the first rows of larger ones, whose further inputs get zero there."""
    if pooled:
        larger, smaller = larger.unflatten(1, (2, -1)), smaller.unflatten(1, (2, -1))
    larger[: len(smaller)] = 0.0
    larger[tuple(slice(n) for n in smaller.shape)] = smaller
