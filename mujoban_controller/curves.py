"""Write a run's learning curve: `python -m mujoban_controller.curves RUN --out docs/results/json/curve.jsonl`.

One JSON object a line: `step` (environment steps) and `value`, the share of moves and pushes that were completed
while the run collected its data, all rows and imperfect termination signals included.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mujoban_rl.weights import write_atomically

KINDS = ("move", "push")


@dataclass(frozen=True)
class Options:
    """Write the learning curve of a training run."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run directory."""
    out: Path
    """File to write."""
    every: int = 12_800
    """Environment steps that make up a point."""
    offset: int = 0
    """Environment steps of the runs whose weights this one started from."""
    append: bool = False
    """Keep the points that the file has."""


def points(lines: Iterable[Mapping[str, Any]], every: int, offset: int = 0) -> list[dict[str, float]]:
    """Return step, value and number of instructions of each stretch of `every` steps that had any."""
    bins: dict[int, list[float]] = {}
    last = 0
    for line in lines:
        last = line["step"]
        counts = [line.get(f"instruction/{kind}_n", 0.0) for kind in KINDS]
        if not sum(counts):
            continue
        completed = sum(n * line[f"instruction/{kind}"] for n, kind in zip(counts, KINDS, strict=True) if n)
        entry = bins.setdefault((line["step"] - 1) // every, [0.0, 0.0])
        entry[0] += completed
        entry[1] += sum(counts)
    return [
        {"step": offset + min((b + 1) * every, last), "value": completed / n, "instructions": round(n)}
        for b, (completed, n) in sorted(bins.items())
    ]


def main() -> int:
    """Run the command."""
    options = tyro.cli(Options)
    try:
        lines = [json.loads(line) for line in (options.run / "metrics.jsonl").read_text().splitlines()]
        before = options.out.read_text() if options.append else ""
    except (OSError, ValueError) as error:
        print(f"mujoban_controller.curves: error: {error}", file=sys.stderr)
        return 2
    found = [json.dumps(point) for point in points(lines, options.every, options.offset)]
    write_atomically(options.out, (before + "\n".join(found) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
