"""Losses of state estimator and control termination (paper C.1, C.4).

Shapes: B robots, T ticks.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from mujoban_core.grid import AGENT, CHANNELS
from mujoban_estimator.estimator import BINARY, Estimates


class Views(NamedTuple):
    """Which cells the camera has had in view; weighs the estimator's loss."""

    now: Tensor
    """In this tick, bool [B, T, 10, 10]."""
    ever: Tensor
    """In this or an earlier tick of the episode, bool [B, T, 10, 10]."""


def estimator_loss(
    estimates: Estimates, label: Tensor, views: Views, valid: Tensor, *, unseen: float, frame: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the sum of independent cross-entropies per tick and its parts.

    Args:
        estimates: outputs of the estimator.
        label: true abstract state, [B, T, 10, 10, 4].
        views: cells in view.
        valid: 1 for ticks that count, [B, T].
        unseen: weight of cells that were never in view; 1 is the paper's loss. Guessing them matters least.
        frame: weight of the auxiliary loss on what single frames say of the cells in view.
    """
    count = valid.sum().clamp(min=1.0)
    binary = list(BINARY)
    bits = F.binary_cross_entropy_with_logits(estimates.logits[..., binary], label[..., binary], reduction="none")
    weight = unseen + (1.0 - unseen) * views.ever.to(bits.dtype)
    # Shape [3]
    layers = (bits * (weight * valid[..., None, None])[..., None]).sum(dim=(0, 1, 2, 3)) / count
    whereabouts = torch.log_softmax(estimates.logits[..., AGENT].flatten(-2), dim=-1)
    agent = -(whereabouts * label[..., AGENT].flatten(-2)).sum(dim=-1)
    agent = (agent * valid).sum() / count
    shown = (views.now.to(bits.dtype) * valid[..., None, None])[..., None]
    single = F.binary_cross_entropy_with_logits(estimates.frame_logits, label[..., binary], reduction="none")
    single = (single * shown).sum() / count
    parts = {CHANNELS[layer]: layers[i].detach() for i, layer in enumerate(binary)}
    return layers.sum() + agent + frame * single, {**parts, "agent": agent.detach(), "frame": single.detach()}


def missed_steps(logits: Tensor, completed: Tensor) -> Tensor:
    """Return N_missed: earlier ticks at which the prediction was negative while the label was positive, [B, T]."""
    missed = ((logits <= 0) & completed).to(logits.dtype)
    return missed.cumsum(dim=1) - missed


def termination_loss(
    logits: Tensor, phases: Tensor, completed: Tensor, true_phases: Tensor, valid: Tensor, *, place: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the re-weighted cross-entropy per tick, w_t = 1 + N_missed, and its parts.

    Args:
        logits: of p(beta), ticks of one instruction each, [B, T].
        phases: what the camera says of the place within the cell, [B, T, 4].
        completed: label of paper C.4, bool [B, T].
        true_phases: label of `phases`.
        valid: 1 for ticks that count, [B, T].
        place: weight of the auxiliary loss on `phases`.
    """
    count = valid.sum().clamp(min=1.0)
    weight = (1.0 + missed_steps(logits.detach(), completed)) * valid
    entropy = F.binary_cross_entropy_with_logits(logits, completed.to(logits.dtype), reduction="none")
    entropy = (entropy * weight).sum() / count
    auxiliary = ((phases - true_phases).square().mean(dim=-1) * valid).sum() / count
    return entropy + place * auxiliary, {"beta": entropy.detach(), "place": auxiliary.detach()}
