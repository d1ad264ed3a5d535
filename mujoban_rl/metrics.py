"""What a training run has written into `metrics.jsonl`, read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


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
