"""What a training run has written into `metrics.jsonl`, read again."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

METRICS: Final = "metrics.jsonl"
"""File of a run that has them, a line each time."""
COUNT: Final = "_n"
"""Ends the name under which a line says of how many values a mean is."""


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the lines of a run, in the order of `step`.

    A run that was killed went on from its last checkpoint: what it had come to after that was lost, and is left out. So
    is a last line that breaks off, as where the disk was full.

    Raises:
        ValueError: If they are missing or damaged.
    """
    lines: list[dict[str, Any]] = []
    try:
        whole, _, _ = (run / METRICS).read_text().rpartition("\n")
        for line in map(json.loads, whole.splitlines()):
            while lines and any(lines[-1].get(spent, 0.0) > line.get(spent, 0.0) for spent in ("step", "cpu_seconds")):
                lines.pop()
            lines.append(line)
    except (OSError, json.JSONDecodeError, AttributeError) as error:
        why = f"no {METRICS}" if isinstance(error, OSError) else f"{METRICS}: {error}"
        raise ValueError(f"{run}: {why}, expected the run directory of a trainer") from error
    return lines


def drop_half_line(file: Path) -> None:
    """Cut off a last line that breaks off, so that none is written behind it; there need not be such a file."""
    if not file.exists():
        return
    content = file.read_bytes()
    if (kept := content.rfind(b"\n") + 1) < len(content):
        os.truncate(file, kept)


def mean_of(lines: Iterable[dict[str, Any]], keys: Sequence[str]) -> tuple[float, float] | None:
    """Return the mean of what lines say under some names, and of how many values it is; None if that is none.

    Each value counts once, a mean of n as n: episodes that are solved end sooner than others, in lines with few.
    """
    said = [(line[key], line.get(key + COUNT, 1.0)) for line in lines for key in keys if line.get(key) is not None]
    total = sum(count for _, count in said)
    return (sum(value * count for value, count in said) / total, total) if total else None
