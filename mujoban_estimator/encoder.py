"""The ResNet that state estimator and control termination share (paper C.1, C.4; He et al. 2016)."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mujoban_core.camera import FRAME_SIZE
from mujoban_rl.networks import PreActivatedBlock

STRIDE: Final = 4
"""Pixels of a frame per row or column of the feature map."""
FEATURE_SIZE: Final = FRAME_SIZE // STRIDE
"""H = W, rows and columns of the feature map."""


class FrameEncoder(nn.Module):
    """Frames uint8 [N, 64, 64, 3] -> features [N, C, 16, 16]."""

    def __init__(self, stem: int, channels: int, blocks: int) -> None:
        """Make the network: `stem` channels at half resolution, then `channels` and `blocks` at a quarter."""
        super().__init__()
        self.channels = channels
        self.layers = nn.Sequential(
            nn.Conv2d(3, stem, 4, stride=2, padding=1),
            PreActivatedBlock(stem),
            nn.ReLU(inplace=True),
            nn.Conv2d(stem, channels, 4, stride=2, padding=1),
            *(PreActivatedBlock(channels) for _ in range(blocks)),
            nn.ReLU(inplace=True),
        ).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, frames: Tensor) -> Tensor:
        """Return the features of frames."""
        # A permuted NHWC tensor is channels_last already.
        return self.layers(frames.permute(0, 3, 1, 2).float() / 127.5 - 1.0)


def check_frames(frames: NDArray[np.uint8]) -> None:
    """Raise ValueError unless frames are RGB, uint8 [B, 64, 64, 3]."""
    if frames.dtype != np.uint8 or frames.shape[1:] != (FRAME_SIZE, FRAME_SIZE, 3):
        raise ValueError(
            f"frames are {frames.dtype} {list(frames.shape)}: expected uint8 [B, {FRAME_SIZE}, {FRAME_SIZE}, 3]"
        )
