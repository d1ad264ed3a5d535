"""What a training run has written into `metrics.jsonl`, read again."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

COUNT: Final = "_n"
"""Ends the name under which a line says of how many values a mean is."""


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the lines of a run, in the order of `step`.

    A run that was killed went on from its last checkpoint: what it had come to after that was lost, and is left out.

    Raises:
        ValueError: If they are missing or damaged.
    """
    lines: list[dict[str, Any]] = []
    try:
        for line in map(json.loads, (run / "metrics.jsonl").read_text().splitlines()):
            while lines and any(lines[-1].get(spent, 0.0) > line.get(spent, 0.0) for spent in ("step", "cpu_seconds")):
                lines.pop()
            lines.append(line)
    except (OSError, json.JSONDecodeError, AttributeError) as error:
        why = "no metrics.jsonl" if isinstance(error, OSError) else f"metrics.jsonl: {error}"
        raise ValueError(f"{run}: {why}, expected the run directory of a trainer") from error
    return lines


def mean_of(lines: Iterable[dict[str, Any]], keys: Sequence[str]) -> tuple[float, float] | None:
    """Return the mean of what lines say under some names, and of how many values it is; None if that is none.

    Each value counts once, a mean of n as n: episodes that are solved end sooner than others, in lines with few.
    """
    said = [(line[key], line.get(key + COUNT, 1.0)) for line in lines for key in keys if line.get(key) is not None]
    total = sum(count for _, count in said)
    return (sum(value * count for value, count in said) / total, total) if total else None
