"""What a policy of the goal task is to those that train and judge it, whatever it sees.

Shapes: M windows of a batch, W ticks of a window, n ticks that are skipped, U actuators.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mujoban_controller.drivers import Driver
from mujoban_rl.networks import Gaussian


class GoalPolicy(nn.Module, ABC):
    """A policy over torques that learns in the goal task."""

    file_name: ClassVar[str]
    """Of the weights that a run exports, without the ending."""
    config: dict[str, Any]
    """Arguments that build it."""
    action_size: int
    """U."""

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    @abstractmethod
    def over_windows(self, batch: Mapping[str, Tensor], skipped: int) -> Gaussian:
        """Return the distributions in the ticks of windows [M, W, ...] from number `skipped` on, [M, W - n, U]."""

    @abstractmethod
    def normalise(self, batch: Mapping[str, Tensor]) -> None:
        """Fit the normalisation of inputs to windows [M, W, ...], as far as it is not fitted already."""

    @abstractmethod
    def driver(self) -> Driver:
        """Return what drives the robots of a goal task by the mean torques, limited to [-1, 1]."""
