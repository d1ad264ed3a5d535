"""How networks compute in training: in bfloat16 where the processor has instructions for it, and by sound kernels."""

from __future__ import annotations

import os
from typing import Final

import torch

_BFLOAT16: Final = ("amx_bf16", "avx512_bf16", "bf16")
"""Instructions for bfloat16 as `torch.cpu.get_capabilities` names them, of x86 and of ARM."""


def limit_kernels() -> None:
    """Keep oneDNN from its kernels for AVX2 on processors without AVX-512, unless the environment says otherwise.

    They crash, or change from call to call, in gradients of the controller's convolutions. Those for AVX take 1.4 times
    as long there, those for SSE4.1 2.6 times. oneDNN reads the variable with its first kernel. Who does not train keeps
    the kernels for AVX2, so that all nodes of a graph round alike.
    """
    if torch.backends.cpu.get_cpu_capability() == "AVX2":
        os.environ.setdefault("DNNL_MAX_CPU_ISA", "AVX")


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
