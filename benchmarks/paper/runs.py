"""The evaluations behind the paper's tables and figures, and where their JSON lies.

`python -m benchmarks.paper.runs` reruns them (hours on two cores); `--only NAME` reruns one. Rebuilding the
tables from the JSON takes seconds: `make results`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro

ROOT: Final = Path(__file__).resolve().parents[2]
RESULTS: Final = ROOT / "docs" / "results"
JSON: Final = RESULTS / "json"
SEED: Final = 1000
"""Seed of the first of the 512 unseen levels (paper C.5); a test seed, like all that a user types."""


class ResultError(ValueError):
    """The JSON of an evaluation is missing or not what `evaluate.py` writes."""


@dataclass(frozen=True)
class Run:
    """One evaluation of the stack and the paper's value for it."""

    name: str
    title: str
    difficulty: int = 5
    oracle: tuple[str, ...] = ()
    paper_success: float | None = None
    """Success rate in the paper's Table 1 or 2."""
    paper_reward: float | None = None

    @property
    def file(self) -> Path:
        """Where the evaluation's JSON lies."""
        return JSON / f"{self.name}.json"

    def command(self, episodes: int) -> list[str]:
        """Return the command that runs the evaluation, relative to the repository."""
        oracle = ["--oracle", ",".join(self.oracle)] if self.oracle else []
        return [
            *("bringup/evaluate.py", "--difficulty", str(self.difficulty), "--episodes", str(episodes)),
            *("--seed", str(SEED), *oracle, "--json", str(self.file.relative_to(ROOT))),
        ]


SENSE: Final = ("estimator", "termination")
CONFIGURATIONS: Final = (
    Run("default", "default", paper_success=0.787, paper_reward=11.42),
    Run("planner_controller", "planner + controller only", oracle=SENSE, paper_success=0.818, paper_reward=11.83),
    Run("controller", "controller only", oracle=(*SENSE, "planner"), paper_success=0.943, paper_reward=13.33),
)
"""The rows of Table 2; the first is also Table 1's modular row."""
DIFFICULTY: Final = (
    *(Run(f"difficulty_{d}", f"difficulty {d}", difficulty=d) for d in range(1, 5)),
    CONFIGURATIONS[0],
)
"""The points of Figure 2, difficulty 1 to 5."""
ALL: Final = (*CONFIGURATIONS, *DIFFICULTY[:-1])


def load(run: Run) -> dict[str, Any] | None:
    """Return the evaluation's JSON, or None when it has not been run.

    Raises:
        ResultError: If the file lacks a key.
    """
    if not run.file.exists():
        return None
    content = json.loads(run.file.read_text())
    missing = {"success_rate", "success_interval", "mean_return", "episodes", "weights"} - content.keys()
    if missing:
        raise ResultError(f"{run.file}: lacks {', '.join(sorted(missing))}; rerun {' '.join(run.command(512))}")
    return content


def main(episodes: int = 512, only: tuple[str, ...] = ()) -> None:
    """Rerun the evaluations.

    Args:
        episodes: Levels per evaluation (paper C.5: 512).
        only: Names of the evaluations to rerun; all of them by default.
    """
    unknown = set(only) - {run.name for run in ALL}
    if unknown:
        sys.exit(f"unknown evaluation {', '.join(sorted(unknown))}: expected some of {', '.join(r.name for r in ALL)}")
    JSON.mkdir(parents=True, exist_ok=True)
    for run in ALL:
        if not only or run.name in only:
            subprocess.run([sys.executable, *run.command(episodes)], check=True, cwd=ROOT)


if __name__ == "__main__":
    tyro.cli(main)
