"""How many threads the numeric libraries use."""

from __future__ import annotations

import os
import sys
from typing import Final

_VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def set_threads(count: int) -> None:
    """Let PyTorch use so many threads, and BLAS and OpenMP as well where they are not loaded yet.

    Raises:
        ValueError: If the number is below 1.
    """
    if count < 1:
        raise ValueError(f"{count} threads: expected at least 1")
    # These libraries read their variables when they are loaded; child processes inherit them.
    for variable in _VARIABLES:
        os.environ[variable] = str(count)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(count)
