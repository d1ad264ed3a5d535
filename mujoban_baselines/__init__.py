"""The agents that modular RL is compared with in the paper's Table 1 (appendix D): networks, tasks, training, node."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mujoban_core.agent import Agent


def load(path: str | Path | None = None, device: str = "cpu") -> Agent:
    """Return an agent with given weights; its record tells which one it is.

    Raises:
        mujoban_rl.weights.WeightsError: If there are none, or they are damaged or do not fit.
    """
    from mujoban_baselines.agents import AGENTS, playing
    from mujoban_rl.weights import WeightsError, load_weights, read_record

    if path is None:
        raise WeightsError("no weights of an agent ship: expected a .safetensors file of mujoban_baselines.train")
    name = read_record(path)["class"]
    if name not in AGENTS:
        raise WeightsError(f"{path}: holds weights of {name}, expected one of {', '.join(AGENTS)}")
    return playing(load_weights(AGENTS[name], path, device))
